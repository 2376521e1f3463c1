"""A page on which the parts of a mesh are painted by hand."""
