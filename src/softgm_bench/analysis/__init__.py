"""Reading of finished runs: statistics, tables, figures, attention."""
