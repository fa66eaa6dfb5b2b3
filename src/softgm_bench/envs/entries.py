"""The environment's tensordict entries, each told once: key, shape, type, and what becomes of it over an episode.

Specs, frames, episode records, summaries, the columns of CSV files and the metrics of training are made from ``TABLE``;
models share nothing with environments but these names. Everything that an actor may read is listed in ``OBSERVATION``;
relative quantities are functions of these entries and are computed inside the models.

Shapes stand behind ``num_envs`` (B). Letters are sizes: N agents, A numbers in an agent's action, M obstacle slots,
P privileged numbers.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor

from softgm_bench.envs.interface import Sizes
from softgm_bench.rod.randomise import FACTORS

Dimension = int | str

# How an episode or an iteration reduces an entry to one number.
SUM, DISCOUNTED, MEAN, RECENT, COUNT, EVER, LAST, LAST_COUNT, STEPS, MAX = (
    "sum",
    "discounted sum",
    "mean",
    "mean that forgets, a tenth a step",
    "number of steps above 0",
    "ever",
    "last",
    "last, a whole number",
    "number of steps",
    "max",
)


@dataclass(frozen=True)
class Column:
    """A number that an entry is reduced to.

    Attributes:
        name: the column's.
        reduction: one of the words above.
        key: the entry's.
    """

    name: str
    reduction: str
    key: NestedKey


@dataclass(frozen=True)
class Entry:
    """An entry of the environment's tensordicts.

    Attributes:
        key: its place.
        shape: behind ``num_envs``.
        dtype: float32 or bool.
        bounded: whether it lies in [-1, 1].
        episode: columns of an episode's record.
        iteration: column of ``metrics.csv``, over all steps of an iteration; None: it has none.
    """

    key: NestedKey
    shape: tuple[Dimension, ...]
    dtype: torch.dtype
    bounded: bool
    episode: tuple[Column, ...]
    iteration: Column | None


TABLE: Final[dict[NestedKey, Entry]] = {}


def _entry(
    *key: str,
    shape: tuple[Dimension, ...] = (1,),
    dtype: torch.dtype = torch.float32,
    bounded: bool = False,
    episode: Mapping[str, str] | None = None,
    iteration: tuple[str, str] | None = None,
) -> NestedKey:
    """Add an entry to ``TABLE`` and give its key; ``episode`` and ``iteration`` are names and reductions of columns."""
    nested: NestedKey = key[0] if len(key) == 1 else key
    columns = tuple(Column(name, reduction, nested) for name, reduction in (episode or {}).items())
    TABLE[nested] = Entry(
        nested, shape, dtype, bounded, columns, None if iteration is None else Column(*iteration, nested)
    )
    return nested


# Every actor and critic may read these.
AGENT_POSITION = _entry("agents", "position", shape=("N", 3))  # m
AGENT_VELOCITY = _entry("agents", "velocity", shape=("N", 3))  # m/s
PREVIOUS_ACTION = _entry("agents", "previous_action", shape=("N", "A"), bounded=True)  # normal, binormal
EDGE = _entry("agents", "edge", shape=("N", "M"), dtype=torch.bool)  # agent i senses the bin in slot k now
SLOT_DESCRIPTOR = _entry("slots", "descriptor", shape=("M", 9))  # centre, axis, radius, length, axial position; PAD: 0
SLOT_ACTIVE = _entry("slots", "active", shape=("M",), dtype=torch.bool)  # the slot holds a discovered bin
TIP = _entry("tip", shape=(3,))  # m
TARGET = _entry("target", shape=(3,))  # m
OBSERVATION = tuple(TABLE)

# The task knows this of a scene beyond the observation: for critics, which only training has, and for policies that are
# labelled as oracles. Walls: the opening's centre (3) and side (1), m. Absent where P is 0.
PRIVILEGED = _entry("privileged", shape=("P",))

ACTION = _entry("agents", "action", shape=("N", "A"), bounded=True)
LOG_PROB = ("agents", "action_log_prob")  # (B, N), written by policies
# Of policies that remember: hidden states (B, N, H) before a frame, and, written by them, after it.
MEMORY = ("agents", "memory")
NEXT_MEMORY = ("next", *MEMORY)

REWARD = _entry("reward", episode={"discounted_return": DISCOUNTED, "undiscounted_return": SUM})  # the team's
DONE = _entry("done", dtype=torch.bool, episode={"length": STEPS})
TERMINATED = _entry("terminated", dtype=torch.bool)  # success, divergence or too much contact
TRUNCATED = _entry("truncated", dtype=torch.bool)  # the horizon alone
IS_INIT = _entry("is_init", dtype=torch.bool)  # an episode's first frame: nothing may be remembered

# Metrics, which no policy reads.
SUCCESS = _entry("info", "success", dtype=torch.bool, episode={"success": EVER})
DIVERGED = _entry("info", "diverged", dtype=torch.bool, episode={"diverged": EVER})
CONTACT_FAILURE = _entry(  # too many steps of contact ended the episode; only where there is a limit
    "info", "contact_failure", dtype=torch.bool, episode={"contact_failure": EVER}
)
TIP_STEP = _entry(  # way of the tip in this control step, m
    "info", "tip_step", episode={"tip_travel_distance": SUM, "final_tip_step": RECENT}
)
DISTANCE = _entry(  # tip to target, m
    "info", "distance", episode={"final_distance": LAST}, iteration=("tip_distance", MEAN)
)
TORQUE_PER_AGENT = _entry(  # mean over agents of ||u_i||, N m
    "info", "torque_per_agent", episode={"torque_per_agent": MEAN}, iteration=("torque_per_agent", MEAN)
)
TORQUE_JOINT = _entry(  # norm over agents and axes, N m
    "info", "torque_joint", episode={"torque_joint": MEAN}, iteration=("torque_joint", MEAN)
)
CONTACT_NODES = _entry(  # C_t, rod nodes in contact
    "info", "contact_nodes", episode={"contact_steps": COUNT}, iteration=("contact_nodes", MEAN)
)
DISCOVERED = _entry(  # bins in the table
    "info", "discovered", episode={"discovered_bins": LAST_COUNT}, iteration=("discovered_bins", MEAN)
)
DROPPED = _entry(  # bins that found no free slot this episode
    "info", "dropped", episode={"dropped_bins": LAST_COUNT}, iteration=("dropped_bins", MAX)
)
DIFFICULTY = _entry(
    "info", "difficulty", iteration=("difficulty", MEAN)
)  # of the scene, 1: the task's; curriculum only

# The episode's body: factors on the nominal arm's parameters, by name; only where bodies are drawn.
BODY = {name: _entry("info", f"body_{name}", episode={f"body_{name}": LAST}) for name in FACTORS}

REWARD_TERMS = "reward_terms"  # the paper's eight, by name
REWARD_TERM_NAMES = ("distance", "progress", "smoothness", "time", "collision", "discovery", "stuck", "success")
for _name in REWARD_TERM_NAMES:
    _entry(REWARD_TERMS, _name, episode={f"reward_{_name}": SUM}, iteration=(f"reward_{_name}", MEAN))

OPTIONAL = (DIFFICULTY, CONTACT_FAILURE, *BODY.values())
INFO = tuple(key for key in TABLE if key[0] == "info" and key not in OPTIONAL)
EPISODE_COLUMNS = tuple(column for entry in TABLE.values() for column in entry.episode)
ITERATION_COLUMNS = tuple(entry.iteration for entry in TABLE.values() if entry.iteration is not None)

_GROUPS = {"agents": "N", "slots": "M"}  # nested tensordicts with a batch dimension of their own


def shape_of(key: NestedKey, sizes: Sizes) -> tuple[int, ...]:
    """Give an entry's shape behind ``num_envs`` for these sizes."""
    return tuple(_resolved(dimension, sizes) for dimension in TABLE[key].shape)


def group_shape(group: str, sizes: Sizes) -> tuple[int, ...]:
    """Give the dimensions that a nested tensordict has behind ``num_envs``: those of agents and slots have one."""
    return (_resolved(_GROUPS[group], sizes),) if group in _GROUPS else ()


def frame(
    values: Mapping[NestedKey, Tensor], batch_size: Iterable[int], sizes: Sizes, device: torch.device
) -> TensorDict:
    """Put entries, ``(*batch_size, *shape)`` each, into one nested tensordict of that batch size."""
    batch = list(batch_size)
    groups: dict[str, dict[str, Tensor]] = {}
    root: dict[str, Tensor | TensorDict] = {}
    for key, value in values.items():
        if isinstance(key, str):
            root[key] = value
        else:
            groups.setdefault(key[0], {})[key[1]] = value
    for name, group in groups.items():
        root[name] = TensorDict(group, [*batch, *group_shape(name, sizes)], device=device)
    return TensorDict(root, batch, device=device)


def _resolved(dimension: Dimension, sizes: Sizes) -> int:
    if isinstance(dimension, int):
        return dimension
    by_letter = {"N": sizes.n_agents, "A": sizes.action, "M": sizes.n_slots, "P": sizes.n_privileged}
    return by_letter[dimension]
