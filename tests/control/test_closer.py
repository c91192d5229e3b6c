"""What pictures from the ground tell of targets, and what they do not."""

import numpy as np

from torchvision_dddas.control.ground_confirmation import drop_fast_targets
from torchvision_dddas.people.confirmation import GroundObservation


def test_people_beside_the_way_of_a_car_do_not_make_it_human_and_its_empty_view_still_counts():
    apart = np.ones(4)
    seen = GroundObservation(np.ones(4, bool), np.array([3, 3, 0, 2]), apart, apart, np.full(4, 0.9))
    velocity = np.array([[5.0, 0.0], [1.2, 0.3], [0.0, 7.0], [np.nan, np.nan]])
    assert drop_fast_targets(seen, velocity).looked.tolist() == [False, True, True, True]
