"""Prefect without a server to start: the embedded API in a private home, quiet, gone afterwards.

Where the user has set PREFECT_API_URL, that server is used and nothing here interferes. Import this module before prefect.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

# Prefect reads these when it is imported.
if "PREFECT_API_URL" not in os.environ and "PREFECT_HOME" not in os.environ:
    # Concurrent first starts in one home collide (measured), hence one a process.
    home = tempfile.mkdtemp(prefix="tsmftis-prefect-")
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    os.environ["PREFECT_HOME"] = home
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")
os.environ.setdefault("PREFECT_SERVER_LOGGING_LEVEL", "CRITICAL")
os.environ.setdefault("PREFECT_LOGGING_LEVEL", "CRITICAL")
os.environ.setdefault("PREFECT_CLI_PROMPT", "false")
# Twenty seconds are Prefect's own patience with its embedded server, too few on a machine that is busy.
os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "180")


@contextmanager
def quiet_engine() -> Iterator[None]:
    """Prefect with heartbeats off (each flow's end would wait a second for one) and its loggers silenced."""
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    for name in ("prefect", "prefect.flow_runs", "prefect.task_runs", "httpx", "uvicorn"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield
