"""What kinds of observations there are, for player and challenger alike."""

import numpy as np
from gymnasium import spaces

#: Key of the observations that says which challenge the player plays.
CHALLENGE = "challenge"
#: What a point cloud has at least, in points, and at most, in features of a point (xyz, normals, colours, labels). Arrays of
#: another shape are taken for something else as well, such as the last states one upon another.
FEWEST_POINTS, MOST_FEATURES = 32, 16


def is_vector(space: spaces.Space) -> bool:
    """1-D Box."""
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def is_cloud(space: spaces.Space) -> bool:
    """2-D float Box, (points, features): what can be read as a point cloud."""
    return isinstance(space, spaces.Box) and len(space.shape) == 2 and np.issubdtype(space.dtype, np.floating)


def looks_like_cloud(space: spaces.Space) -> bool:
    """A 2-D float Box of many points with at least x and y. What else can be read as a cloud is more likely something else."""
    if not is_cloud(space):
        return False
    points, features = space.shape  # type: ignore[misc]
    return points >= FEWEST_POINTS and 2 <= features <= MOST_FEATURES
