"""How scenes, steps, graphs and shapes show themselves in a notebook.

Jupyter asks what stands at the end of a cell for its `_repr_html_`; the classes answer with `draw_cell`. A
cell is small, loads nothing, runs no script, and takes its colours from the page around it, light or dark.
"""

from caryatid.viz.notebook.cells import draw_cell

__all__ = ["draw_cell"]
