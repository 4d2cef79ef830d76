"""`caryatid export`: the scene model of a run for other programs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import General, Settings, defaults_to, one_of
from caryatid.config.choices import ExportFormat


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write the scene model of a run for simulators, viewers and programs that work with graphs.

    To try:
      caryatid export run --format mjcf --out scene.xml
      caryatid export run --out scene.glb
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, as explore and extract write it, or a graph.json."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write: .xml (mjcf), .urdf, .glb, .gltf, .graphml, .dot or .gv; replaces one already there."""
    format: Annotated[ExportFormat | None, one_of(ExportFormat), defaults_to("as FILE ends")] = None
    """mjcf: free bodies on a table; urdf: links fixed to the world; gltf: meshes; graphml, dot: the graph."""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)
    general: tyro.conf.OmitArgPrefixes[General] = field(default_factory=General)

    def __call__(self) -> int:
        """Run the command."""
        config = self.settings.settings()
        from caryatid.cli.progress import Progress, summary
        from caryatid.exports.writing import export_graph, format_of
        from caryatid.io.graph_json import read_graph
        from caryatid.io.json_files import json_text
        from caryatid.io.runs import read_run
        from caryatid.runtime.interrupts import interruptible

        format_ = self.format or format_of(self.out)
        graph = read_graph(self.run) if self.run.suffix == ".json" else read_run(self.run).graph
        with interruptible():
            export_graph(graph, self.out, format_, config.export)
        if self.general.json:
            sys.stdout.write(json_text({"file": str(self.out), "format": format_}))
        progress = Progress(self.general.quiet or self.general.json)
        progress.say(f"{self.out}: {format_}, {summary(graph)}")
        return 0
