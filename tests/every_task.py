"""The tasks that have an arm."""

TASKS = ("basic", "structured", "wall", "wall_narrow", "wall_fixed", "wall_touch", "wall_search", "wall_decoy")
