"""Views that are chosen in a run (`views: {kind: adaptive}`)."""
