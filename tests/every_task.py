"""The tasks that have an arm."""

STILL = (
    "basic",
    "structured",
    "wall",
    "wall_narrow",
    "wall_fixed",
    "wall_touch",
    "wall_sense",
    "wall_search",
    "wall_decoy",
)
MOVING = ("wall_sliding", "swinging_posts")
TASKS = STILL + MOVING
