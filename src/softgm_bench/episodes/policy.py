"""Trained policies: read from a run folder, a checkpoint or a file that holds the actor alone."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from softgm_bench.assembly import build_policy, check
from softgm_bench.config import Config, changed, plain, typed, validate_device
from softgm_bench.config.checks import device_type
from softgm_bench.config.explain import USER_ERRORS
from softgm_bench.envs import Sizes, kind_of
from softgm_bench.envs.section_mixture import members
from softgm_bench.errors import UserError
from softgm_bench.models.finite import not_finite
from softgm_bench.rod.backend import default_backend, runs_on
from softgm_bench.storage import archive
from softgm_bench.storage.files import write_where_asked
from softgm_bench.storage.run_folder import RunFolder

FORMAT = 2  # of a policy's file; 1 was a checkpoint's with nothing but the policy
NETWORKS = ("actor_network.", "actor_network_params.")  # how losses call the actor, in checkpoints without a policy


@dataclass
class TrainedPolicy:
    """A policy, what it came from, and where it is to act.

    Attributes:
        policy: reads ``entries.OBSERVATION``, writes ``entries.ACTION``; deterministic or exploring as the exploration
            type says.
        sizes: of what the policy was trained on.
        config: to act in: the run's, on the device and with the settings that were asked for.
        frames: that it has learnt from.
        versions: of the packages that the run used.
        run: configuration of the run that trained it.
    """

    policy: TensorDictModuleBase
    sizes: Sizes
    config: Config
    frames: int
    versions: dict[str, str]
    run: Config

    @property
    def label(self) -> str:
        """The algorithm's name as results carry it, whatever the policy is to act in."""
        return self.run.label


def load(path: Path, device: str = "cpu", overrides: Sequence[str] = ()) -> TrainedPolicy:
    """Read the policy in a run folder (its newest checkpoint), a checkpoint or a file that ``save`` wrote.

    Args:
        path: of one of them.
        device: to act on.
        overrides: settings ``key=value`` to act in instead of the run's; see ``softgm_bench.config.changed``. Its
            networks must take what is observed there: SoftGM's take any N and M, an MLP's any N.

    Raises:
        UserError: there is none, it is damaged or not finite, this version cannot build its networks, they do not fit
            the settings, or the settings make no sense.
        HydraException, OmegaConfBaseException: a setting cannot be read, is misspelt or of a wrong type.
    """
    validate_device(device)
    file = _file(path)
    state = archive.load(file, device)
    try:
        run = typed(OmegaConf.create(state["config"]))
        sizes = Sizes(**state["sizes"]) if "sizes" in state else kind_of(run.task).sizes(run.task)
        policy = build_policy(run, sizes, state["frames"]).to(torch.device(device))
        policy.load_state_dict(state["policy"] if "policy" in state else _actor_of(state["algorithm"]["loss"], policy))
        result = TrainedPolicy(policy, sizes, _on(run, device), state["frames"], state["versions"], run)
    except (KeyError, AttributeError, TypeError, RuntimeError, ValueError, *USER_ERRORS) as error:
        raise UserError(
            f"{file}: this version cannot build its networks; use the version that trained it, with the same plugins"
        ) from error
    if (found := not_finite(policy.named_parameters())) is not None:
        raise UserError(f"{file}: {found}, its training has diverged; use an earlier checkpoint")
    if overrides:
        result.config = changed(plain(result.config), overrides)
        result.policy = _fitted(file, result)
    return result


def save(trained: TrainedPolicy, path: Path) -> None:
    """Write what acting needs: the actor's parameters, sizes and configuration; no critic, optimiser or simulation.

    Raises:
        UserError: the file cannot be written.
    """
    state = {
        "kind": "policy",
        "format": FORMAT,
        "frames": trained.frames,
        "policy": trained.policy.state_dict(),
        "sizes": asdict(trained.sizes),
        "config": plain(trained.run),
        "versions": trained.versions,
    }
    write_where_asked(path, archive.packed(state))


def fingerprint(trained: TrainedPolicy) -> str:
    """Name the parameters by 16 hexadecimal digits of their hash: two policies that have one name are one."""
    digest = hashlib.sha256()
    for name, value in sorted(trained.policy.state_dict().items()):
        digest.update(name.encode())
        if isinstance(value, torch.Tensor):
            digest.update(value.contiguous().numpy(force=True).tobytes())
    return digest.hexdigest()[:16]


def backend_of(config: Config) -> str | None:
    """Name the implementation of the rod that a policy acts on; None where the task has no arm."""
    if not kind_of(config.task).has_arm:
        return None
    return config.backend or default_backend(device_type(config.device))


def _file(path: Path) -> Path:
    if not path.is_dir():
        return path
    newest = RunFolder(path).newest()
    if newest is None:
        raise UserError(f"{path}: no checkpoint here; name a run folder, a checkpoint or a policy's file")
    return newest


def _on(config: Config, device: str) -> Config:
    """Put the configuration on a device, where a kernel that does not run there is replaced by the device's own."""
    stays = config.backend is None or runs_on(config.backend, device_type(device))
    return replace(config, device=device, backend=config.backend if stays else None)


def _actor_of(loss: Mapping[str, Any], policy: TensorDictModuleBase) -> dict[str, Any]:
    """Find a policy's parameters among those of the loss that trained it; one that explores wraps the actor."""
    parameters = {
        name.removeprefix(prefix): value
        for name, value in loss.items()
        for prefix in NETWORKS
        if name.startswith(prefix)
    }
    return {name: parameters[name.removeprefix("actor.")] for name in policy.state_dict()}


def _fitted(file: Path, trained: TrainedPolicy) -> TensorDictModuleBase:
    """Build the trained policy for what is observed in ``trained.config`` instead of the run's task."""
    config, run = trained.config, trained.run
    if kind_of(config.task) is not kind_of(run.task):
        task = f"task={config.task.name}"
        raise UserError(f"{file}: it was trained on {run.task.name}, whose observations are not those of {task}")
    here = replace(config, threads=None)  # the run's may be more than this machine has
    for one in members(here).values() or [here]:  # arms of several numbers of sections need not learn together
        check(one)
    sizes = kind_of(config.task).sizes(config.task)
    fitted = build_policy(config, sizes, trained.frames).to(torch.device(config.device))
    try:
        fitted.load_state_dict(trained.policy.state_dict())
    except RuntimeError as error:
        raise UserError(f"{file}: {_misfit(trained, sizes)}") from error
    return fitted


def _misfit(trained: TrainedPolicy, sizes: Sizes) -> str:
    """Say which size of what is observed the networks do not take; it is never the number of agents alone."""
    held, task = trained.sizes, f"task={trained.config.task.name}"
    if held.n_features != sizes.n_features:
        return f"its networks read {held.n_features} numbers for each agent, {task} shows {sizes.n_features}"
    if trained.run.oracle and held.n_privileged != sizes.n_privileged:
        return f"its networks are told {held.n_privileged} numbers about a scene, {task} has {sizes.n_privileged}"
    slots, agents = held.n_slots, sizes.n_agents
    advice = f": add task.slots={slots}" if slots and sizes.n_slots else ""
    return f"its networks read {slots} obstacle slots, {task} with {agents} agents has {sizes.n_slots}{advice}"
