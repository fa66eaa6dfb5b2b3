"""How much do policies touch without its being counted? ``python experiments/touches.py [NAME=POLICY.pt ...]``.

Policies play the episodes of ``experiments/sides.py`` by their own rules. It is taken down in which control steps an
obstacle pushes the arm, in any substep, and at whose end a node touches one, which is what ``contact_counts=at_end``
counts. Figures go to ``experiments/touches/<name>.json``; what lies there is not played again. Then the table in
``docs/choosing.md`` between ``<!-- touches -->`` and ``<!-- end -->`` is made of all of them.
"""

import torch
from sides import EPISODES, LENGTH, PAGE, ROOT, SEED, first_episodes, main, share, table
from torch import Tensor

from softgm_bench import api
from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_env
from softgm_bench.envs import SoftArmEnv, entries
from softgm_bench.episodes.policy import TrainedPolicy

FOLDER = ROOT / "experiments" / "touches"
CAMPAIGN, TRIALS = ROOT / "experiments" / "campaign", ROOT / "experiments" / "trials" / "wall_sense"
POLICIES = {
    "`wall_touch`, SoftGM, seed 0, at most 10 steps": CAMPAIGN / "wall_touch" / "softgm" / "seed0" / "policy.pt",
    "`wall_touch`, SoftGM without stage 1, seed 0, at most 10 steps": (
        CAMPAIGN / "wall_touch" / "softgm_no_stage1" / "seed0" / "policy.pt"
    ),
    "`wall_sense`, SoftGM, seed 0, none at ends": TRIALS / "eased0_seed0_average" / "policy.pt",
    "`wall_sense`, SoftGM without stage 1, seed 0, none at ends": TRIALS / "eased0_blind0_average" / "policy.pt",
}
COLUMNS = (
    "success",
    "steps at whose end a node touches, an episode",
    "steps in which an obstacle pushes, an episode",
    "successes that were never pushed",
)


def watch(env: SoftArmEnv) -> list[Tensor]:
    """Take down which arms are pushed in the control steps to come, ``(num_envs,)`` bool each."""
    move, seen = env.backend.control_step, []

    def control_step(*args, **kwargs):
        seen.append(torch.zeros(env.batch_size, dtype=torch.bool))
        return move(*args, **kwargs | {"touched": seen[-1]})

    env.backend.control_step = control_step  # of this environment alone
    return seen


def play(trained: TrainedPolicy) -> list[float | None]:
    """One number for each of ``COLUMNS``, over the environments' first episodes."""
    env = build_env(trained.config, EPISODES, SEED)
    seen = watch(env)
    after = api.rollout(env, trained, LENGTH)["next"]
    first = first_episodes(after)
    pushed = torch.stack(seen[-first.shape[1] :], dim=1) & first
    touching = (after[entries.CONTACT_NODES].squeeze(-1) > 0.0) & first
    success = (after[entries.SUCCESS].squeeze(-1) & first).any(1)
    return [
        share(success),
        float(touching.sum(1).double().mean()),
        float(pushed.sum(1).double().mean()),
        share(~pushed.any(1)[success]),
    ]


def page(text: str) -> str:
    """``docs/choosing.md`` with the table made anew."""
    return refilled(PAGE, text, {"touches": table(FOLDER, COLUMNS)})


if __name__ == "__main__":
    main(FOLDER, POLICIES, play, page)
