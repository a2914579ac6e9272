"""Who is next among steps that are not live: the owner that has used the least."""

from collections.abc import Iterable

# Who uses less than its share may be so far behind the others, and gets its steps at once.
_MOST_BEHIND_S = 0.5


class Shares:
    """The time of the model that each owner has used for steps that are not live.

    Nobody saves up for later: who begins to wait is at most a little behind those that wait.
    """

    def __init__(self) -> None:
        self._used_s: dict[str, float] = {}

    def enter(self, owner: str, others: Iterable[str]) -> None:
        """Count an owner whose step begins to wait beside the steps of ``others``."""
        used = [self._used_s[each] for each in others if each != owner]
        if not used:
            self._used_s = {owner: 0.0}  # with nobody else, past use does not matter
            return
        self._used_s[owner] = max(self._used_s.get(owner, 0.0), max(used) - _MOST_BEHIND_S)

    def charge(self, owner: str, seconds: float) -> None:
        """Count what a step has used."""
        if owner in self._used_s:
            self._used_s[owner] += seconds

    def used_s(self, owner: str) -> float:
        """Return what an owner has used since others wait beside it."""
        return self._used_s.get(owner, 0.0)
