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
    ],
)
def test_a_label_is_read_as_a_name(label, name):
    assert names.algorithm(label) == name
