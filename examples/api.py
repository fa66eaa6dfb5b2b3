"""What the commands do, from Python: ``python examples/api.py [FOLDER]`` (half a minute)."""

import sys
from pathlib import Path

from torchrl.envs.utils import step_mdp

from softgm_bench import api
from softgm_bench.envs import entries


def main() -> None:
    """Build, roll out, train, evaluate, act, record."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("outputs/api")

    # Four arms in front of walls, moved by uniform actions.
    env = api.make_env("task=wall", num_envs=4, seed=0)
    frames = api.rollout(env, steps=20)
    print(f"reward of the first steps: {frames['next', entries.REWARD][0, :3].flatten().tolist()}")

    # A training of seconds, which teaches nothing; without experiment=smoke it takes as long as the command does.
    run = api.train("algo=softgm", "task=basic", "experiment=smoke", f"run_dir={folder}", "overwrite=true")
    print(f"success in {run.folder}: {run.summary['final_evaluation']['success_rate']['mean']}")

    # The policy on another task than it was trained on.
    trained = api.load(run.folder, "task=structured", "task.horizon=50")
    print(api.evaluate(trained, episodes=8, seed=1))

    # The same by hand: a loop of your own.
    env = api.make_env("task=basic", num_envs=2, seed=0)
    observation, policy = env.reset(), api.load(run.folder)
    for _ in range(10):
        observation[entries.ACTION] = api.act(policy, observation)
        observation = step_mdp(env.step(observation))
    print(f"where the tips are now, m: {observation[entries.TIP].tolist()}")

    # One episode as arrays.
    episode = api.record(run.folder, seed=0, horizon=25)
    print(f"positions of the nodes, {episode.steps} steps: {episode.position.shape}")


if __name__ == "__main__":
    main()
