"""Reads and checks plan, rig and LED table; derives views, bursts and shots from them."""
