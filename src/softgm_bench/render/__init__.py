"""Stills, videos and an interactive page of one episode, drawn without a GPU, a display or a system library."""
