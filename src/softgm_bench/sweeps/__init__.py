"""Many runs: the cells of a grid in processes of their own, and what became of each."""
