"""The page to relight: a result in one HTML file that any browser opens from disk; docs/reference/page.md."""
