"""Drawings and tables of what is known: the report in HTML and PDF, notebook cells, pictures of the docs."""
