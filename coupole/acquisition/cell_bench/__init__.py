"""The process that holds a cell's devices for consoles while no run is at work: `coupole bench`."""
