"""Drivers of real devices. They import only the contracts from `coupole`: devices, errors, geometry,
kinematics.
"""
