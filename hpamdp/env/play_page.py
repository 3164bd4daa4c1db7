"""What a problem that people can play in a browser hands over: a page, its data, and the check of what was played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol


class EpisodeError(ValueError):
    """An episode that cannot have been played, or is none at all; the message is one line."""


class PlayPage(Protocol):
    """A page in a browser on which people play a problem.

    Attributes:
        files: its static files by their names, one of which is `index.html`. The page also loads `data.js`, a script
            that sets `window.HPAMDP_DATA` to what `data` returns.
        shows_agents: whether agents can play beside people.
    """

    files: Mapping[str, Path]
    shows_agents: bool

    def data(self, agents: Sequence[Mapping[str, Any]], *, has_server: bool) -> dict[str, Any]:
        """Return the JSON values that the page's script starts with.

        Args:
            agents: to play beside people: `name`, `title`, `score`, `env` (the settings of the problem), and
                `agent`, what `HierarchicalAgent.exported` returns.
            has_server: whether a server receives the episodes.

        Raises:
            EpisodeError: an agent was trained on other rules than those of the page.
        """

    def check(self, episode: object) -> dict[str, Any]:
        """Return an episode from the page as it is to be stored.

        Args:
            episode: decoded JSON, of any kind.

        Raises:
            EpisodeError: it is no episode, or nobody can have played it.
        """

    def told(self, episodes: Sequence[Mapping[str, Any]]) -> str:
        """Return a sentence about checked episodes, for the end of the command; an empty text tells nothing."""
