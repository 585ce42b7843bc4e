"""The HTML report: sections, tables and figures."""
