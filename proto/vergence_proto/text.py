"""Text files as any system writes them: by editors of Windows too, with a byte order mark."""

import codecs
import re

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",  # starts like UTF-16, so it comes first
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_UNMARKED = {0: "utf-16-be", 1: "utf-16-le"}  # by the place of the zero
_NO_TEXT = re.compile("[\x00-\x08\x0e-\x1f]")


def decoded_text(data: bytes) -> str | None:
    """Decode UTF-8, UTF-16 or UTF-32 by its byte order mark, else UTF-8, else Latin-1.

    The mark is taken off. UTF-16 without one shows by the zero beside its first character.
    None: it is not text.
    """
    marked = (name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark))
    encoding = next(marked, _UNMARKED.get(data[:2].find(0), "utf-8"))
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8":
            return None
        text = data.decode("latin-1")  # older editors wrote the degree sign and the like so
    return None if _NO_TEXT.search(text) else text
