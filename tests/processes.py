"""Python in a process of its own."""

import subprocess
import sys


def python(*words, **more):
    """Run it with these words, and return what it wrote and how it ended."""
    given = {"capture_output": True, "text": True, "check": False, **more}
    return subprocess.run([sys.executable, *map(str, words)], **given)


def printed(*words, **more):
    """Return its output, and assert that it ends well."""
    done = python(*words, **more)
    assert done.returncode == 0, done.stderr
    return done.stdout
