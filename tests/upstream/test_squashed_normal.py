import torch
from torchrl.modules import TanhNormal

from round_trips import RoundTrips
from softgm_bench.upstream.squashed_normal import SquashedNormal

SETTINGS = {"tanh_loc": True, "upscale": 3.0, "event_dims": 1}


def test_it_is_torchrls_distribution_bit_by_bit():
    loc, scale = torch.randn(50, 4, 2), torch.rand(50, 4, 2) + 0.1
    said = []
    for kind in (SquashedNormal, TanhNormal):
        distribution = kind(loc, scale, **SETTINGS)
        torch.manual_seed(1)
        action, log_prob = distribution.rsample_and_log_prob()
        said.append((action, log_prob, distribution.deterministic_sample, distribution.log_prob(action.detach())))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(*said, strict=True))


def test_building_it_asks_the_device_less_than_torchrls_does():
    loc, scale = torch.randn(5, 4, 2), torch.rand(5, 4, 2) + 0.1
    asked = []
    for kind in (SquashedNormal, TanhNormal):
        kind(loc, scale, **SETTINGS)  # what is asked only once is left out
        with RoundTrips() as trips:
            kind(loc, scale, **SETTINGS)
        asked.append(len(trips.found))
    assert asked[0] < asked[1]
