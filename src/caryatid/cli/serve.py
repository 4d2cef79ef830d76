"""`caryatid serve`: sessions over HTTP."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from caryatid.cli.options import SAID, General, whole_number
from caryatid.config.settings import read_settings
from caryatid.errors import InputError

NEEDED = ("fastapi", "starlette", "pydantic", "uvicorn")
"""What the extra `serve` brings."""

Count = Annotated[int, whole_number(1)]
Port = Annotated[int, whole_number(0)]

GENERAL = General()


@dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve sessions over HTTP, to robot software in any language; an OpenAPI page at /docs says how.

    At 127.0.0.1 only this machine's own programs come, and need no token. Any other --host demands one, as
    `Authorization: Bearer TOKEN`; without encryption, so use it within a network you trust.

    To try:
      caryatid serve sessions
      CARYATID_TOKEN=$(openssl rand -hex 16) caryatid serve sessions --host 0.0.0.0
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the sessions; made if missing."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at."""
    port: Port = 8765
    """Port to listen at; 0 = any that is free."""
    token: Annotated[str | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="TOKEN"), SAID] = None
    """What requests have to bear; better given as CARYATID_TOKEN, where no process list shows it."""
    open_sessions: Count = 4
    """Sessions kept open; others are opened from disk when they are asked for, in a tenth of a second."""
    waiting: Count = 16
    """Requests that may wait; more are told to try again."""
    max_request: Count = 16
    """Size of a request at the most [MB]."""
    config: Annotated[Path | None, tyro.conf.DisallowNone, tyro.conf.arg(metavar="FILE.toml"), SAID] = None
    """Settings of new sessions, in place of the defaults."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="STAGE.NAME=VALUE")] = ()
    """One setting of new sessions; goes before the file's."""
    general: tyro.conf.OmitArgPrefixes[General] = GENERAL

    def __call__(self) -> int:
        """Run the command."""
        config = read_settings(self.config, self.set)
        try:
            from caryatid.service.serving import run_service
        except ModuleNotFoundError as error:
            if error.name not in NEEDED:
                raise
            raise InputError("serve", f"needs {error.name}", 'pip install "caryatid[serve]"') from None
        return run_service(
            self.folder,
            config,
            host=self.host,
            port=self.port,
            token=self.token or os.environ.get("CARYATID_TOKEN") or None,
            open_sessions=self.open_sessions,
            waiting=self.waiting,
            max_request=self.max_request * 1_000_000,
            quiet=self.general.quiet,
            json=self.general.json,
        )
