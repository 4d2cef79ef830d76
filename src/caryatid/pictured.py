"""What shows itself in a notebook."""


class Pictured:
    """Gives a class its picture in a notebook; `caryatid.notebook` draws it, imported when it is asked."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        from caryatid.notebook import draw_cell

        return draw_cell(self)
