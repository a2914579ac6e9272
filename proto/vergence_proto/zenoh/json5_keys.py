"""The keys that a JSON5 file sets. Zenoh reads the file; it does not say what was in it."""

import re
from collections.abc import Iterator

# https://spec.json5.org: comments, strings of both quotes, names without quotes, and braces.
_TOKEN = re.compile(
    r"""(?P<comment>//[^\n]*|/\*.*?\*/)
    |(?P<string>"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')
    |(?P<mark>[{}\[\],:])
    |(?P<word>[^\s{}\[\],:"'/]+)""",
    re.VERBOSE | re.DOTALL,
)


def keys_of(text: str) -> Iterator[str]:
    """Yield the path of each key of a JSON5 object, with slashes, as Zenoh writes them: ``a/b/c``.

    Objects inside lists are passed over. A file that is not JSON5 gives some keys or none.
    """
    path: list[str | None] = []  # the key of each open object or list; None inside a list
    latest: str | None = None
    for token in _TOKEN.finditer(text):
        match token.lastgroup, token[0]:
            case "string", quoted:
                latest = quoted[1:-1]
            case "word", word:
                latest = word
            case "mark", ":" if latest is not None:
                if path:
                    path[-1] = latest
                if None not in path:
                    yield "/".join(str(each) for each in path)
                latest = None
            case "mark", "{":
                path.append("")
            case "mark", "[":
                path.append(None)
            case "mark", "}" | "]" if path:
                path.pop()
            case "mark", ",":
                latest = None
