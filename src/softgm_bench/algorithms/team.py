"""The team's reward and ends, given to each of its agents: here and nowhere else."""

from torch import Tensor


def give_to_agents(of_team: Tensor, n_agents: int) -> Tensor:
    """One reward, end of an episode, advantage or value of the team as every agent's own.

    Args:
        of_team: ``(..., 1)``.
        n_agents: N.

    Returns:
        ``(..., N, 1)``, a view.
    """
    return of_team.unsqueeze(-2).expand(*of_team.shape[:-1], n_agents, 1)
