"""Four position controllers from the literature, each with the same soft arm, as baselines for `adaptive/recommended`."""
