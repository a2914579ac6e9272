"""Sources of frames for commands: a ``KIND:PATH`` argument becomes an open data set."""

from vergence.cli.errors import CliError
from vergence_proto.datasets import DatasetError, StereoSource, open_source


def source_at(text: str) -> StereoSource:
    """Open ``KIND:PATH``. Raises CliError: it does not exist, is damaged, or has no frames."""
    try:
        source = open_source(text)
    except DatasetError as error:
        raise CliError(str(error), exit_code=2) from None
    if len(source) == 0:
        raise CliError(f"{text}: no frames", exit_code=2)
    return source
