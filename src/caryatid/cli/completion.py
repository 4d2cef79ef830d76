"""`caryatid completion`: the shell completes commands, options and their values."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from caryatid.cli.options import General

Shell = Literal["bash", "zsh", "fish", "tcsh"]


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Write what has a shell complete commands, options and their values.

    To try:
      source <(caryatid completion bash)
      caryatid completion bash > ~/.local/share/bash-completion/completions/caryatid
      caryatid completion zsh > "${fpath[1]}/_caryatid"
      caryatid completion fish > ~/.config/fish/completions/caryatid.fish
      caryatid completion tcsh > ~/.caryatid.tcsh && echo source ~/.caryatid.tcsh >> ~/.tcshrc
    """

    shell: Annotated[Shell, tyro.conf.Positional]
    """The shell to write for."""
    general: tyro.conf.OmitArgPrefixes[General] = field(default_factory=General)

    def __call__(self) -> int:
        """Run the command."""
        from caryatid.cli.completing import completion_script

        script = completion_script(self.shell)
        if self.general.json:
            from caryatid.io.json_files import json_text

            script = json_text({"shell": self.shell, "script": script})
        sys.stdout.write(script)
        return 0
