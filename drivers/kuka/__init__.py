"""KUKA arms."""
