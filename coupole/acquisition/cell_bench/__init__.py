"""The process that holds a cell's devices for consoles while no run uses the cell: `coupole bench`."""
