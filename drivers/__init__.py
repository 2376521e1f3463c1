"""Drivers of real devices. Of `coupole` they import the contracts only: devices, errors, geometry, kinematics."""
