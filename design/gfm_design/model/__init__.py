"""The model: operating point, linear and sampled loop, many loops at once."""
