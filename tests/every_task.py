"""The tasks that have an arm."""

FELT = ("wall_touch", "wall_sense", "wall_search", "wall_decoy")  # walls that have to be felt
STILL = ("basic", "structured", "wall", "wall_narrow", "wall_fixed", *FELT)
MOVING = ("wall_sliding", "swinging_posts")
TASKS = STILL + MOVING
