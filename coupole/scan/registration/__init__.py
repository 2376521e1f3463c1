"""Many scans of one object with unknown poses: matched, checked, adjusted together, merged."""
