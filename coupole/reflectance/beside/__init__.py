"""Processing of a run beside its acquisition, in a process of its own that reads the run's folder alone."""
