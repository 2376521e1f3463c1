"""Drivers of real devices. They know `coupole.devices`, `coupole.errors`, `coupole.geometry`, nothing more."""
