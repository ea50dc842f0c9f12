"""The limits of a scene."""

import pytest

from spacesim.data.errors import InputError
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.spacecraft import boxsat


def test_more_than_the_labels_can_tell_apart_is_refused():
    craft = boxsat()
    with pytest.raises(InputError, match="84 objects and 255 parts"):
        Scene("crowd", tuple(SceneObject(craft) for _ in range(255 // len(craft.parts) + 1)))
