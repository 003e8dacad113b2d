"""Keep some of an unknown number of things, evenly spread over all of them, in bounded memory."""

from collections.abc import Iterable
from typing import Any

__all__ = ["Thinned"]


class Thinned:
    """Keeps every n-th thing it is given; n doubles whenever too many have come together.

    Args:
        most: Things kept at the end lie between this number and its double.
    """

    def __init__(self, most: int = 400) -> None:
        self.most, self.items, self._stride, self._seen = most, [], 1, 0

    def extend(self, items: Iterable[Any]) -> None:
        """Take in several things."""
        for item in items:
            self.add(item)

    def add(self, item: Any) -> None:
        """Take in the next thing, or let it pass."""
        if self._seen % self._stride == 0:
            self.items.append(item)
        self._seen += 1
        if len(self.items) > 2 * self.most:
            self.items, self._stride = self.items[::2], 2 * self._stride
