"""What runs before the last few left in a store: solutions of a team that has grown since."""

from groundfuse.tools.store import Store

OF_THE_WHOLE = (
    "vocabulary",
    "retrieval",
    "graph",
    "graphs",
    "patches",
    "bundle",
    "mosaic",
    "overhead",
)
"""Kinds of entries that are made anew whenever a team has grown; what is of a picture, of a pair or
of a part of a mosaic is not among them."""
MOST_OF_EACH = 8
"""A run that finds a camera file wrong asks for up to six of a kind; the others are for whoever
goes back to what was asked for before."""


def forget_superseded(store: Store) -> None:
    """Remove what was superseded long ago (DataError: the disk fails)."""
    store.forget_older(OF_THE_WHOLE, MOST_OF_EACH)
