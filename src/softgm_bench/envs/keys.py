"""Names of the environment's tensordict entries: the only thing that models share with environments.

Shapes are for ``num_envs`` environments (B), N agents, M obstacle slots and P privileged numbers (the environment's
``n_privileged``). Everything an actor may read is listed in ``OBSERVATION``; relative quantities are functions of these
entries and are computed inside the models.
"""

# What every actor and critic may read.
AGENT_POSITION = ("agents", "position")  # (B, N, 3) float32, m
AGENT_VELOCITY = ("agents", "velocity")  # (B, N, 3) float32, m/s
PREVIOUS_ACTION = ("agents", "previous_action")  # (B, N, 2) float32 in [-1, 1]: normal, binormal
EDGE = ("agents", "edge")  # (B, N, M) bool: agent i senses the bin in slot k now
SLOT_DESCRIPTOR = ("slots", "descriptor")  # (B, M, 9) float32: centre, axis, radius, length, axial position; PAD: 0
SLOT_ACTIVE = ("slots", "active")  # (B, M) bool: the slot holds a discovered bin
TIP = "tip"  # (B, 3) float32, m
TARGET = "target"  # (B, 3) float32, m

OBSERVATION = (
    AGENT_POSITION,
    AGENT_VELOCITY,
    PREVIOUS_ACTION,
    EDGE,
    SLOT_DESCRIPTOR,
    SLOT_ACTIVE,
    TIP,
    TARGET,
)

# What the task knows of a scene beyond the observation: for critics, which only training has, and for policies that are
# labelled as upper bounds. The entry is absent where P is 0.
PRIVILEGED = "privileged"  # (B, P) float32; walls: the opening's centre (3) and side (1), m

ACTION = ("agents", "action")  # (B, N, 2) float32 in [-1, 1]
LOG_PROB = ("agents", "action_log_prob")  # (B, N)

REWARD = "reward"  # (B, 1) float32, the team's
DONE = "done"  # (B, 1) bool
TERMINATED = "terminated"  # (B, 1) bool: success or divergence
TRUNCATED = "truncated"  # (B, 1) bool: the horizon alone

# Written under "next" for metrics; no policy reads them.
SUCCESS = ("info", "success")  # (B, 1) bool
DIVERGED = ("info", "diverged")  # (B, 1) bool
DISTANCE = ("info", "distance")  # (B, 1) float32, tip to target, m
TIP_STEP = ("info", "tip_step")  # (B, 1) float32, distance the tip moved in this control step, m
CONTACT_NODES = ("info", "contact_nodes")  # (B, 1) float32, C_t
DISCOVERED = ("info", "discovered")  # (B, 1) float32, bins in the table
DROPPED = ("info", "dropped")  # (B, 1) float32, bins that found no free slot this episode
TORQUE_PER_AGENT = ("info", "torque_per_agent")  # (B, 1) float32, mean over agents of ||u_i||, N m
TORQUE_JOINT = ("info", "torque_joint")  # (B, 1) float32, norm over agents and axes, N m
DIFFICULTY = ("info", "difficulty")  # (B, 1) float32, of the episode's scene, 1: the task's own; with a curriculum only
REWARD_TERMS = "reward_terms"  # nested: the eight terms by name, (B, 1) float32 each
REWARD_TERM_NAMES = (
    "distance",
    "progress",
    "smoothness",
    "time",
    "collision",
    "discovery",
    "stuck",
    "success",
)
