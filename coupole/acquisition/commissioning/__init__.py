"""Commissioning of a cell: its safety figures are measured at reduced speed, step by step, while a person
confirms."""
