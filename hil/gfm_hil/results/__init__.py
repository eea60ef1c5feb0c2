"""What a run showed: summary, metrics, figures, report and export files."""
