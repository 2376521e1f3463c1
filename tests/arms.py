"""The arms that come with Coupole, as tests need them."""

from __future__ import annotations

from coupole.plan.arm_description import shipped_arm

KR10 = shipped_arm("kr10_r1100_sixx")
UR5E = shipped_arm("ur5e")
UR10E = shipped_arm("ur10e")
KR10_R1100_SIXX = KR10.arm
