"""Registration of many scans of one object with unknown poses: matching, checks, joint adjustment, merging."""
