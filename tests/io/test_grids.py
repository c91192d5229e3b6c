"""Places in UTM and MGRS."""

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.maps.grids import check_grid, grid_rows

# In Arizona and in Sydney, unknown, and north of UTM.
PLACES = np.array([[-110.95, 31.6], [151.2153, -33.8568], [np.nan, np.nan], [10.0, 86.0]])


def test_utm_has_its_zone_and_is_empty_where_there_is_none():
    rows = grid_rows("utm", PLACES)
    assert rows["utm_zone"] == ["12R", "56H", None, None]
    # The place is 0.05 degrees east of the zone's central meridian, which lies at 500 km.
    beside_m = 0.9996 * 6.384e6 * np.radians(0.05) * np.cos(np.radians(31.6))
    assert rows["utm_east_m"][0] == pytest.approx(500_000 + beside_m, abs=20)
    assert np.isnan(rows["utm_north_m"][2:]).all()


def test_references_of_mgrs_are_those_of_utm_to_the_metre():
    rows, utm = grid_rows("mgrs", PLACES), grid_rows("utm", PLACES)
    for k, zone in enumerate(("12R", "56H")):
        reference = rows["mgrs"][k]
        assert reference.startswith(zone) and len(reference) == 15
        assert int(reference[5:10]) == int(utm["utm_east_m"][k]) % 100_000
        assert int(reference[10:]) == int(utm["utm_north_m"][k]) % 100_000
    assert rows["mgrs"][2] is None and rows["mgrs"][3].startswith("Z")


def test_a_grid_without_degrees_is_one_line():
    check_grid("", False)
    with pytest.raises(InputError, match="grid=utm needs longitudes and latitudes"):
        check_grid("utm", False)
