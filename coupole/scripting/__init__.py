"""The Python interface, `import coupole`: runs, results, plans, acquisitions and cells for scripts and
notebooks."""
