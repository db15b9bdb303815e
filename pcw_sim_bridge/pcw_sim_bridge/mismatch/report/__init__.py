"""The report: a page, a file for programs, the patched description and figures."""
