"""``vergence serve`` with a model whose steps take long: ``python -m`` this module, seconds."""

import sys

from tests.support.models import PacedModel
from vergence_service.app import command, server
from vergence_service.settings import Settings


class SlowModel(PacedModel):
    def close(self) -> None:
        """End with the process."""


def main(step_s: float) -> None:
    def make_model(settings: Settings) -> SlowModel:
        return SlowModel(step_s)

    server.make_model = make_model  # type: ignore[assignment] # a model of tests
    command.run_server({"grpc.port": 0, "http.port": 0}, config=None, print_config=False)


if __name__ == "__main__":
    main(float(sys.argv[1]))
