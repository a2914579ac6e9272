"""The number of iterations that a step takes."""

from collections.abc import Mapping
from dataclasses import dataclass

from vergence_proto.errors import ModelChanged
from vergence_proto.model_io import ModelCard
from vergence_proto.types import Delivery
from vergence_service.streams.stream import StreamConfig


@dataclass(frozen=True, slots=True, eq=False)
class IterationCounts:
    """The server's choices: for a warm step, and for a cold step of each delivery."""

    card: ModelCard
    warm: int
    cold: Mapping[Delivery, int]

    def loaded_for(self, delivery: Delivery) -> tuple[int, int]:
        """Return the counts that streams have which ask for none: warm, and cold."""
        return (
            self.card.iterations_at_most(self.warm),
            self.card.iterations_at_most(self.cold[delivery]),
        )

    def of(self, config: StreamConfig, *, cold: bool) -> int:
        """Return the count of one step of a stream."""
        wanted = (
            config.cold_iterations or self.cold[config.delivery]
            if cold
            else config.iterations or self.warm
        )
        return self.card.iterations_at_most(wanted)


def check_weights(config: StreamConfig, card: ModelCard) -> None:
    """Raise ModelChanged if a client asks for other weights than these."""
    if config.weights_sha256 not in ("", card.weights_sha256):
        raise ModelChanged(
            f"expected a server with weights {config.weights_sha256[:12]}, this one runs "
            f"{card.name} with {card.weights_sha256[:12]}; open a new stream to "
            "continue with these"
        )
