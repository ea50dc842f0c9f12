"""Arrays of different sizes in one kernel."""

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.upload import upload
from spacesim.learning.networks.joined import Joined

SIZES = (3, 1, 40, 7)


def arrays(rows: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(rows, size)).astype(np.float32) for size in SIZES]


def test_a_row_and_back():
    @recorded
    def there_and_back(several):
        joined = Joined(SIZES)
        return joined.split(joined.load(several))

    for seed in range(3):
        values = arrays(1, seed)
        for array, value in zip(there_and_back([upload(value) for value in values]), values, strict=True):
            assert np.array_equal(np.array(array), value[0])


def test_rows_at_places_and_numbers_for_all():
    values, joined = arrays(5, 0), Joined(SIZES)
    row = np.concatenate([value[3] for value in values])
    place = ad.UInt32([50, 0, 3, 4, 43, 44])
    assert np.array_equal(np.array(joined.load([upload(v) for v in values], place, 3)), row[np.array(place)])
    numbers = joined.repeat([dr.opaque(ad.Float, i) for i in range(len(SIZES))])
    assert np.array_equal(np.array(numbers), np.repeat(np.arange(len(SIZES)), SIZES))
