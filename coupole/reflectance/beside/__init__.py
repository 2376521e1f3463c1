"""Processing of a run beside its acquisition, in a separate process that only reads the run's folder."""
