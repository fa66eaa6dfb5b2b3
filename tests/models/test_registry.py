from dataclasses import dataclass

import pytest
from observations import SIZES, softgm_config

from softgm_bench.models import (
    MLPConfig,
    MLPEncoder,
    SoftGMConfig,
    SoftGMEncoder,
    VectorMLPConfig,
    build_encoder,
    model_configs,
)
from softgm_bench.models.informarl import InforMARLConfig
from softgm_bench.models.registry import register_model
from softgm_bench.models.section_transformer import SectionTransformerConfig


def test_the_configuration_chooses_the_encoder():
    assert isinstance(build_encoder(softgm_config(), SIZES), SoftGMEncoder)
    assert isinstance(build_encoder(MLPConfig(hidden=8, layers=1, velocity_scale=1.0), SIZES), MLPEncoder)
    softgm = dict.fromkeys(("softgm", "softgm_no_stage1", "softgm_no_stage2", "softgm_remember"), SoftGMConfig)
    informarl = dict.fromkeys(("informarl", "informarl_remember"), InforMARLConfig)
    transformer = [f"section_transformer{which}" for which in ("", "_all", "_remember")]
    others = {"mlp": MLPConfig, "vector_mlp": VectorMLPConfig}
    assert model_configs() == softgm | informarl | dict.fromkeys(transformer, SectionTransformerConfig) | others


def test_a_configuration_of_no_model_is_refused():
    with pytest.raises(ValueError, match="no model's configuration"):
        build_encoder({"hidden": 8}, SIZES)


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="registered already"):
        register_model("softgm", config=dict)(MLPEncoder)


def test_settings_that_several_names_share_say_which_it_is():
    @dataclass
    class Nameless:
        hidden: int

    with pytest.raises(ValueError, match="Nameless is shared by one, another: it needs a field name: str"):
        register_model("one", "another", config=Nameless)(MLPEncoder)
    assert "one" not in model_configs()
