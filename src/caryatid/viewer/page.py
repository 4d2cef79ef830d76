"""The page: the scene after each view, a slider over the views, and what is known beside it."""

from __future__ import annotations

import contextlib
import logging
import webbrowser
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from html import escape
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.graph import SupportGraph
from caryatid.support.relations import predict_removal
from caryatid.viewer import panels
from caryatid.viewer.drawing import LAYERS, Moment, SceneDrawing, reduced
from caryatid.viz.colours import SERIES

POINT_SIZE = 0.003
"""Diameter of a point at first [m]."""
ACCENT = (11, 92, 148)
FIELD_OF_VIEW = 0.72
"""Of the eye [rad]; narrow, so that what is near does not hide what is far."""
FAR, NEAR = 3.2, 1.7
"""How far from the scene the eye begins over the floor [m]: with all cameras in sight, or the table only."""
BESIDE = 380
"""Width of the panel with the graph [px]."""


class Page:
    """A viewer in the browser, served by this process.

    Moments are added as they come, from any thread; they are drawn in a thread of the page's own, and where
    they come faster than they are drawn the newest is.

    Args:
        title: What the page is of.
        support: The numbers the graphs were inferred with: they say what would fall.
        host: Address to listen at; at 127.0.0.1 only this machine's own programs come.
        port: Port to listen at, or the next free one; 0 = any that is free.
        small: It has little room, as within a notebook: panels begin folded up.

    Attributes:
        url: Where the page is.
        working: Held by whoever runs compiled kernels, which not every threading layer lets two threads do.

    Raises:
        InputError: viser is not installed, or nothing can be listened at.
    """

    def __init__(
        self,
        title: str,
        support: SupportConfig | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        small: bool = False,
    ) -> None:
        self.working = RLock()
        self._support = support or SupportConfig()
        self._server = server = _serve(title, host, port)
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
        self._moments: list[Moment] = []
        self._shown = -1
        self._chosen = ""
        self._staged: Moment | None = None
        self._graph_drawn: SupportGraph | None = None
        self._drawer = ThreadPoolExecutor(1, "viewer")
        self._pending: Future[None] | None = None
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=ACCENT)
        server.scene.set_up_direction("+z")
        self._drawing = SceneDrawing(server, self.choose)
        self._distance = NEAR if small else FAR
        self._build(small)

    @property
    def server(self) -> Any:
        """The `viser.ViserServer`, for controls of one's own."""
        return self._server

    @property
    def moments(self) -> tuple[Moment, ...]:
        """What has been added so far."""
        return tuple(self._moments)

    @property
    def shown(self) -> Moment | None:
        """The moment on display."""
        return self._moments[self._shown] if self._moments else None

    @property
    def drawing(self) -> SceneDrawing:
        """The scene in the page."""
        return self._drawing

    def say(self, text: str) -> None:
        """Say something at the top of the page, in place of what was said before."""
        self._notice.content = panels.in_page(f"<p>{escape(text)}</p>")
        self._notice.visible = bool(text)

    def open_browser(self) -> None:
        """Open the page in the user's browser, if there is one."""
        webbrowser.open(self.url)

    def add(self, moment: Moment) -> None:
        """Add a moment, or put it in place of that of the same view; who looks at the newest goes along."""
        newest = self._shown == len(self._moments) - 1
        moment = replace(moment, step=reduced(moment.step))
        if moment.step.index < len(self._moments):
            self._moments[moment.step.index] = moment
        else:
            self._moments.append(moment)
            if newest:
                self._shown = len(self._moments) - 1
        if len(self._moments) == 1:
            self._look_at(moment)
        self.redraw()

    def go_to(self, index: int) -> None:
        """Show the moment after a view."""
        index = min(max(index, 0), len(self._moments) - 1)
        if index != self._shown:
            self._shown = index
            self._staged = None
            self.redraw()

    def look_from(self, eye_world: ArrayLike, target_world: ArrayLike) -> None:
        """Have everybody look from one point (3,) at another (3,) [m]."""
        for client in self._server.get_clients().values():
            client.camera.position = np.asarray(eye_world, dtype=np.float64)
            client.camera.look_at = np.asarray(target_world, dtype=np.float64)

    def choose(self, object_id: str) -> None:
        """Show what is known of an object."""
        self._chosen = object_id
        self.redraw()

    def stage(self, moment: Moment | None) -> None:
        """Show a moment that is none of those after a view; None goes back to those."""
        if moment is not self._staged:
            self._staged = moment
            self.redraw()

    def redraw(self) -> None:
        """Draw what is to be shown, soon; where that is already about to be done, once."""
        if self._pending is None or self._pending.running() or self._pending.done():
            with contextlib.suppress(RuntimeError):
                self._pending = self._drawer.submit(self._draw)
                self._pending.add_done_callback(_said)

    def wait(self) -> None:
        """Wait until all that has been asked for is drawn; what went wrong meanwhile is raised."""
        self._drawer.submit(lambda: None).result()
        if self._pending is not None:
            self._pending.result()

    def close(self) -> None:
        """Stop serving the page."""
        self._drawer.shutdown(wait=True, cancel_futures=True)
        with _silent():
            self._server.stop()

    def _build(self, small: bool) -> None:
        gui = self._server.gui
        self._notice = gui.add_html("", order=-20, visible=False)
        self._slider = gui.add_slider("view", 0, 1, 1, 0, disabled=True, hint="Go back to an earlier view")
        self._slider.on_update(lambda _: self.go_to(int(self._slider.value)))
        self._told = gui.add_html("")
        with gui.add_folder("show", expand_by_default=False, order=90):
            for name in LAYERS:
                self._layer(name)
            self._true_colours = gui.add_checkbox("colours of the camera", False)
            self._size = gui.add_slider("point size [mm]", 1.0, 12.0, 0.5, 1000.0 * POINT_SIZE)
        for control in (self._true_colours, self._size):
            control.on_update(lambda _: self.redraw())
        panel = gui.add_panel()
        with panel.add_tab("supports"):
            self._graph = gui.add_html("")
        self._scores = panel.add_tab("F1")
        with self._scores:
            self._no_chart = gui.add_html(panels.in_page("<p>The truth is not known here.</p>"))
        with panel.add_tab("key"):
            gui.add_html(panels.describe_signs())
        self._chart: Any = None
        if not small:
            gui.main_panel.dock_right()
        panel.dock_left()
        panel.set_width(BESIDE)
        about = gui.add_panel()
        with about.add_tab("object"):
            self._about = gui.add_html(panels.in_page(panels.NOTHING_CHOSEN))
        about.dock_below(panel)
        if small:
            panel.minimize()

    def _layer(self, name: str) -> None:
        box = self._server.gui.add_checkbox(name, True)
        box.on_update(lambda _: self._drawing.show_layer(name, box.value))

    def _look_at(self, moment: Moment) -> None:
        """Have the eye begin over the shoulder of the first camera, or before the middle of what is there."""
        camera = self._server.initial_camera
        centre = moment.step.sphere.centre_world
        backward = np.array([-1.0, -0.7, 0.0])
        if len(moment.step.visited):
            x, y = moment.step.visited[0][:2]
            backward = np.array([x - 0.5 * y, y + 0.5 * x, 0.0])
        backward /= max(float(np.linalg.norm(backward)), 1e-9)
        camera.look_at = centre
        camera.position = centre + self._distance * (backward + [0.0, 0.0, 0.7])
        camera.fov = FIELD_OF_VIEW

    def _draw(self) -> None:
        moment, chosen = self._staged or self.shown, self._chosen
        if moment is None:
            return
        self._drawing.show(
            moment,
            [m.step for m in self._moments[: self._shown + 1]],
            chosen=chosen,
            point_size=self._size.value / 1000.0,
            true_colours=self._true_colours.value,
        )
        last = len(self._moments) - 1
        self._slider.max = max(last, 1)
        self._slider.disabled = last == 0
        self._slider.value = self._shown
        self._told.content = panels.describe_view(moment, len(self._moments))
        graph = moment.step.graph
        if graph is not self._graph_drawn:
            self._graph_drawn = graph
            self._graph.content = panels.describe_graph(graph)
        self._draw_scores()
        if chosen:
            self._about.content = self._object(moment, chosen)

    def _object(self, moment: Moment, chosen: str) -> str:
        item = next((o for o in moment.step.graph.objects if o.id == chosen), None)
        effects = None
        if item is not None and item.role == "object":
            with self.working:
                effects = predict_removal(moment.step.graph, chosen, self._support)
        return panels.describe_object(moment.step.graph, chosen, effects)

    def _draw_scores(self) -> None:
        scores = [np.nan if m.score is None else m.score for m in self._moments]
        if np.isnan(scores).all():
            return
        x = np.arange(len(scores), dtype=np.float64)
        data = (x, np.array(scores, dtype=np.float64))
        if self._chart is not None:
            self._chart.data = data
            return
        self._no_chart.visible = False
        with self._scores:
            self._chart = self._server.gui.add_uplot(
                data,
                ({"label": "view"}, {"label": "F1", "stroke": SERIES[0], "width": 2, "points": {"size": 7}}),
                title="F1 after each view",
                scales={"x": {"time": False}, "y": {"range": (0.0, 1.05)}},
                aspect=1.6,
            )


def _said(drawn: Future[None]) -> None:
    """Say what went wrong in the thread that draws; the page then shows what it showed before."""
    error = None if drawn.cancelled() else drawn.exception()
    if error is not None:
        logging.getLogger(__name__).error("a view could not be drawn", exc_info=error)


def needs_viser() -> InputError:
    """The error where viser is not installed."""
    return InputError("viewer", "needs viser", 'pip install "caryatid[view]"')


def _serve(title: str, host: str, port: int) -> Any:
    try:
        import viser
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise needs_viser() from None

    class Server(viser.ViserServer):
        """A server whose page stays on this machine: nobody can ask for a public address."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    with _silent():
        return Server(host=host, port=port, label=title, verbose=False)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
