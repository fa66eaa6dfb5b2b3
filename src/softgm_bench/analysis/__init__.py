"""What is read from runs: statistics, tables, figures, attention."""
