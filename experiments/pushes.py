"""How often is an arm pushed that may be? ``python experiments/pushes.py [NAME=POLICY.pt ...]``.

As ``sides.py``: kept policies play the same episodes of `wall_sense`, here without a limit of contact. Episodes are
split by whether the target lies on the side of the open opening, which nobody can know without sensing it: on the
other side an arm has to turn round. Figures go to ``experiments/pushes/<name>.json``, the table into
``docs/choosing.md`` between ``<!-- pushes -->`` and ``<!-- end -->``.
"""

import torch
from sides import EPISODES, LENGTH, PAGE, ROOT, SEED, first_episodes, main, share, table
from torch import Tensor
from touches import TRIALS, watch

from softgm_bench import api
from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_env
from softgm_bench.config import changed, plain
from softgm_bench.envs import entries
from softgm_bench.episodes.policy import TrainedPolicy

FOLDER = ROOT / "experiments" / "pushes"
POLICIES = {
    "a limit alone, 1.40 M frames": TRIALS / "limit_seed0" / "policy-1401600.pt",
    "a limit alone, 1.88 M frames": TRIALS / "limit_seed0" / "policy.pt",
    "from 1.40 M on a price alone": TRIALS / "price_seed0" / "policy.pt",
}
COLUMNS = (
    "success",
    "steps with a push, median, target on the open side",
    "on the other",
    "succeeded without a push, target on the open side",
    "on the other",
    "both",
)


def play(trained: TrainedPolicy) -> list[float | None]:
    """One number for each of ``COLUMNS``, over the environments' first episodes."""
    env = build_env(changed(plain(trained.config), ["task.max_contact_steps=null"]), EPISODES, SEED)
    seen = watch(env)
    frames = api.rollout(env, trained, LENGTH)
    after = frames["next"]
    first = first_episodes(after)
    pushes = (torch.stack(seen[-first.shape[1] :], dim=1) & first).sum(1)
    success = (after[entries.SUCCESS].squeeze(-1) & first).any(1)
    open_side, targets_side = ((frames[key][..., 1] > 0.0)[:, 0] for key in (entries.PRIVILEGED, entries.TARGET))
    unpushed, same = success & (pushes == 0), open_side == targets_side
    return [
        share(success),
        *(median(pushes[rows]) for rows in (same, ~same)),
        *(share(unpushed[rows]) for rows in (same, ~same)),
        share(unpushed),
    ]


def median(of: Tensor) -> float | None:
    """The middle of some whole numbers, the lower one of two; None of none."""
    return float(of.median()) if len(of) else None


def page(text: str) -> str:
    """``docs/choosing.md`` with the table made anew."""
    return refilled(PAGE, text, {"pushes": table(FOLDER, COLUMNS)})


if __name__ == "__main__":
    main(FOLDER, POLICIES, play, page)
