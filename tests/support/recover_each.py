"""Carries out a command of gfmhil on one folder after another, each in a process of its own.

A program of its own: it loads and compiles everything once, on a good folder, and then forks for
each line of its input, the words of a command in JSON. For each it prints a line of JSON: exit code
(None: it was killed, as one that waits is), processor time in s, peak of memory in MB, and what it
said.
"""

import contextlib
import json
import os
import signal
import sys
import tempfile
from pathlib import Path

from gfm_hil.cli import main

PATIENCE_S = 60
FILES_KB = 0  # mapped from files by this process: a child has them too, but counts what it touches


def mapped_files_kB() -> int:
    """What this process has mapped from files and touched, in kB."""
    return int(Path("/proc/self/status").read_text().partition("RssFile:")[2].split()[0])


def call(words: list[str]) -> dict[str, object]:
    """Carry out a command in a child."""
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as touched:
        child = os.fork()
        if child == 0:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(PATIENCE_S)
            code = 70
            try:
                code = main(words)
            except BaseException:
                sys.excepthook(*sys.exc_info())
            finally:
                os.write(touched.fileno(), str(mapped_files_kB()).encode())
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        _, status, used = os.wait4(child, 0)
        said.seek(0)
        touched.seek(0)
        untouched_kB = max(FILES_KB - int(touched.read() or 0), 0)
        return {
            "code": os.WEXITSTATUS(status) if os.WIFEXITED(status) else None,
            "cpu_s": used.ru_utime + used.ru_stime,
            "peak_MB": (used.ru_maxrss + untouched_kB) / 1e3,
            "said": said.read(200_000).decode("utf-8", "replace"),
        }


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        main(["recover", sys.argv[1]])
    FILES_KB = mapped_files_kB()
    print("ready", flush=True)
    for line in sys.stdin:
        print(json.dumps(call(json.loads(line))), flush=True)
