"""Drivers of real devices. They import only `coupole.devices`, `.errors`, `.geometry` and `.kinematics`."""
