"""Ctrl-C while a command imports torch ends it with one line instead of a traceback.

Later interrupts are exceptions (`cli.signals_raise`).
"""

import os
import signal
import sys
import threading
from types import FrameType

COMMAND = "torch-mpm"


def _end_on_interrupt() -> None:
    """End this process on SIGINT, if it is ``torch-mpm`` or ``python -m torch_mpm``: it has no unfinished files yet.

    Programs that import torch_mpm keep their handler.
    """
    # The name of a module that Python runs is "-m" while its package is imported.
    name = os.path.basename(sys.argv[0] if sys.argv else "")
    if name not in (COMMAND, "-m") or threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, f"{COMMAND}: interrupted\n".encode())
    os._exit(130)


_end_on_interrupt()
