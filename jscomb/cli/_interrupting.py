"""End at once on Ctrl-C: one line, status 130, no file half written."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator

STATUS = 128 + signal.SIGINT


@contextlib.contextmanager
def ends_on_interrupt() -> Iterator[None]:
    """Within it, Ctrl-C ends the process, whatever it does.

    Python would only see the signal when a compiled function returns, and an exception
    in a callback of such a function may be lost, so a thread waits for it.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    stderr = os.dup(2)  # the library redirects it now and then
    before = signal.signal(signal.SIGINT, lambda *_: None)
    wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    arguments = reader, stderr
    threading.Thread(target=_wait, args=arguments, daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGINT, before)
        writer.close()  # ends the thread


def _wait(reader: socket.socket, stderr: int) -> None:
    """Wait for the signal, or for the end."""
    with reader:
        while received := reader.recv(1):
            if received[0] == signal.SIGINT:
                if files := sys.modules.get("jscomb.exr._files"):
                    files.discard_unfinished()
                os.write(stderr, b"jscomb: interrupted\n")
                os._exit(STATUS)
    os.close(stderr)
