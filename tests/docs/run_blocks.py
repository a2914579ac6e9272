"""Run the Python blocks of one page in one namespace: ``python -m tests.docs.run_blocks FILE``.

FILE is JSON: a list of sources. A block may use ``await`` at its top level, as a notebook cell may.
The names ``left``, ``right``, ``rig`` and ``world_from_left`` hold the first frame of the bundled
sequence.
"""

import ast
import asyncio
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from vergence.cli.demo import bundled_sample
from vergence_proto.datasets import open_source


def main() -> None:
    sample = open_source(bundled_sample())
    first = sample[0].frame
    assert first.pose is not None
    names: dict[str, Any] = {
        "__name__": "__main__",
        "left": first.left,
        "right": first.right,
        "rig": sample.rig,
        "world_from_left": first.pose,
    }
    # One loop for the pages' own ``await``; a block that starts a loop itself is not inside it.
    loop = asyncio.new_event_loop()
    for source in json.loads(Path(sys.argv[1]).read_text()):
        flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        code = compile(source, "a block of the page", "exec", flags=flags)
        if code.co_flags & inspect.CO_COROUTINE:
            loop.run_until_complete(eval(code, names))
        else:
            exec(code, names)
    loop.close()


if __name__ == "__main__":
    main()
