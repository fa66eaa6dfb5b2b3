import pytest

from softgm_bench.analysis import names


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("mappo", "MAPPO"),
        ("mappo_softgm", "MAPPO, softgm"),
        ("softgm_no_stage1", "SoftGM without stage 1"),
        ("softgm_remember", "SoftGM that remembers"),
        ("softgm_remember_noise", "SoftGM that remembers, noise"),
        ("masac_softgm_remember", "MASAC, softgm_remember"),
        ("softgm_oracle", "SoftGM, oracle"),
        ("softgm_informarl", "InforMARL"),
        ("softgm_informarl_gru_noise", "InforMARL, gru_noise"),
        ("softgm_section_transformer", "Section transformer"),
        ("softgm_section_transformer_all", "All-section transformer"),
        ("softgm_section_transformer_remember", "Section transformer that remembers"),
        ("mappo_informarl", "MAPPO, informarl"),
    ],
)
def test_a_label_is_read_as_a_name(label, name):
    assert names.algorithm(label) == name
