"""Random actions through PettingZoo's interface: prints return, length and end of a few episodes::

python examples/pettingzoo_random.py --task wall --episodes 3 --horizon 100
"""

import argparse

from softgm_bench.adapters.pettingzoo import parallel_env
from softgm_bench.envs.tasks import TASKS


def main() -> None:
    """Play the episodes of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=TASKS, default="wall")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--horizon", type=int, default=100, help="control steps of 0.04 s until an episode ends")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    env = parallel_env(arguments.task, horizon=arguments.horizon)
    for index, agent in enumerate(env.possible_agents):
        env.action_space(agent).seed(arguments.seed + index)
    for episode in range(arguments.episodes):
        _, infos = env.reset(seed=arguments.seed if episode == 0 else None)
        team_return, steps = 0.0, 0
        while env.agents:
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
            _, rewards, _, _, infos = env.step(actions)
            team_return += rewards["section_0"]  # the team's: the same for every agent
            steps += 1
        last = infos["section_0"]
        end = "success" if last["success"] else "diverged" if last["diverged"] else f"{last['distance']:.2f} m left"
        print(f"episode {episode}: return {team_return:.2f} in {steps} steps, {end}")
    env.close()


if __name__ == "__main__":
    main()
