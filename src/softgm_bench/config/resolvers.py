"""Resolvers: the functions by which a value in ``conf/`` depends on what was chosen elsewhere.

``gamma: ${tuned_or_paper:0.95, 0.99}`` has both recipes' values in the line that they belong to, so no file overrides
another's and nothing depends on the order of files. A value on the command line, or in a recipe of a user's own,
replaces the whole line.
"""

from typing import Any

from omegaconf import DictConfig, OmegaConf

from softgm_bench.config.schema import PAPER, labelled

SMOKE, GPU = "smoke", "gpu"


def tuned_or_paper(tuned: Any, paper: Any, *, _root_: DictConfig) -> Any:
    """The first value with ``recipe=tuned``, the second with ``recipe=paper``."""
    return _node(paper if OmegaConf.select(_root_, "recipe") == PAPER else tuned)


def on_or_off_policy(on: Any, off: Any, *, _root_: DictConfig) -> Any:
    """The second value for algorithms that learn from a replay (``algo.replay_capacity``), the first for the others."""
    return _node(on if OmegaConf.select(_root_, "algo.replay_capacity") is None else off)


def if_centralised(centralised: Any, independent: Any, *, _root_: DictConfig) -> Any:
    """The first value for algorithms with a centralised critic (``algo.centralised``), the second for the others."""
    return _node(centralised if OmegaConf.select(_root_, "algo.centralised") else independent)


def if_hidden(hidden: Any, plain: Any, *, _root_: DictConfig) -> Any:
    """The first value where something has to be found out (``task.hidden_scene``), the second elsewhere."""
    return _node(hidden if OmegaConf.select(_root_, "task.hidden_scene") else plain)


def in_small_steps(small: Any, large: Any, *, _root_: DictConfig) -> Any:
    """The first value where the tuned recipe learns in small iterations, the second elsewhere.

    Small ones are for what has to be found out (``task.hidden_scene``), by any network but an MLP (``model.name``).
    """
    searches = OmegaConf.select(_root_, "task.hidden_scene") and OmegaConf.select(_root_, "model.name") != "mlp"
    return _node(small if searches else large)


def if_mixture(mixture: Any, one: Any, *, _root_: DictConfig) -> Any:
    """The first value where ``task.n_agents`` is a list of numbers, the second where it is a number."""
    return _node(mixture if OmegaConf.is_list(OmegaConf.select(_root_, "task.n_agents")) else one)


def if_started(started: Any, fresh: Any, *, _root_: DictConfig) -> Any:
    """The first value where training begins with a trained policy (``start.policy``), the second elsewhere."""
    return _node(fresh if OmegaConf.select(_root_, "start.policy") is None else started)


def in_smoke(smoke: Any, otherwise: Any, *, _root_: DictConfig) -> Any:
    """The first value with ``experiment=smoke``, the second with every other experiment."""
    return _node(smoke if OmegaConf.select(_root_, "experiment.name") == SMOKE else otherwise)


def in_gpu(gpu: Any, otherwise: Any, *, _root_: DictConfig) -> Any:
    """The first value with ``experiment=gpu``, the second with every other experiment."""
    return _node(gpu if OmegaConf.select(_root_, "experiment.name") == GPU else otherwise)


def first(*values: Any) -> Any:
    """The first value that is not null; null if all are."""
    return _node(next((value for value in values if value is not None), None))


def label(*, _root_: DictConfig) -> str:
    """Give the name of the results, ``Config.label``, for run folders."""
    cell = OmegaConf.select(_root_, "algo.actor.memory.cell")
    changed = (_root_.perturbation.name, _root_.randomise.name)
    started = OmegaConf.select(_root_, "start.policy") is not None
    return labelled(_root_.algo.name, _root_.model.name, _root_.observation, *changed, cell, started)


def _node(value: Any) -> Any:
    """Give a list or a group as OmegaConf's own, which it can resolve in place (``--cfg job --resolve``)."""
    return OmegaConf.create(value) if isinstance(value, dict | list) else value


def register() -> None:
    """Let YAML call the functions above by their names."""
    by_kind = (tuned_or_paper, on_or_off_policy, if_centralised, if_hidden, in_small_steps, if_mixture, if_started)
    for resolver in (*by_kind, in_smoke, in_gpu, first, label):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
