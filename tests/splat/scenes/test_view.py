"""Views, points and what sees them."""

from functools import lru_cache

import pytest
import torch

from splat.model.camera import Camera
from splat.scenes.view import Frame, Photograph, Points, View, inside_image, pixel_coordinates
from tests.refusals import refused


def camera(x: float = 0.0) -> Camera:
    centre = torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    return Camera(torch.eye(3, dtype=torch.float64), centre, 10.0, 20.0, 4.0, 3.0, 8, 6)


def frame(name: str, x: float = 0.0) -> Frame:
    return Frame(name, camera(x), lambda own: View(name, own, torch.zeros(3, 6, 8)))


def xyz(*rows: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def test_a_picture_of_another_size_than_its_camera_is_refused() -> None:
    refused(r"'a' to be \(3, 6, 8\) as its camera, got \(3, 8, 6\)", View, "a", camera(), torch.zeros(3, 8, 6))
    refused("as its camera", View, "a", camera(), torch.zeros(3, 6, 8), torch.zeros(8, 6))


def test_a_point_falls_where_the_pinhole_equation_says() -> None:
    pixel, depth = pixel_coordinates(camera(1.0), xyz((2.0, 0.5, 5.0)))
    assert pixel.tolist() == [[10 * 1 / 5 + 4, 20 * 0.5 / 5 + 3]] and depth.tolist() == [5.0]


def test_points_inside_are_before_the_camera_in_frame_and_in_range() -> None:
    points = xyz((0, 0, 1), (0, 0, -1), (0.5, 0, 1), (0.39, 0, 1), (0, 0, 9))
    assert inside_image(camera(), points).tolist() == [True, False, False, True, True]
    assert inside_image(camera(), points, (2.0, 10.0)).tolist() == [False, False, False, False, True]


def test_sightings_follow_the_tracks_and_only_the_views_asked_for() -> None:
    observations = torch.tensor([[0, 0], [0, 1], [0, 2], [2, 1]])
    points = Points(xyz((0, 0, 1), (0, 0, 1), (0, 0, 1)), torch.zeros(3, 3), observations, ("a", "b", "c"))
    assert points.sightings([frame("a"), frame("b")]).tolist() == [2, 0, 1]
    assert points.sightings([frame("c"), frame("not of this model")]).tolist() == [1, 0, 0]


def test_without_tracks_a_point_is_seen_where_it_falls_into_the_image() -> None:
    points = Points(xyz((0, 0, 1), (1, 0, 1), (0.5, 0, 2)), torch.zeros(3, 3))
    assert points.sightings([frame("a", 0.0), frame("b", 1.0)]).tolist() == [1, 1, 2]
    assert points.sightings([frame("a", 0.0), frame("b", 0.5)]).tolist() == [1, 0, 2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(2, 3), torch.zeros(3, 3)), "shape"),
        ((torch.full((2, 3), torch.nan), torch.zeros(2, 3)), "finite points"),
        ((torch.zeros(2, 3), torch.zeros(2, 3), torch.tensor([[2, 0]]), ("a",)), "got point 2 in image 0"),
        ((torch.zeros(2, 3), torch.zeros(2, 3), torch.tensor([[1, 1]]), ("a",)), "got point 1 in image 1"),
    ],
)
def test_points_that_cannot_be_are_refused(arguments: tuple, message: str) -> None:
    refused(message, Points, *arguments)


def test_a_shelf_keeps_the_pictures_used_last_and_reads_the_others_again(monkeypatch: pytest.MonkeyPatch) -> None:
    read = []

    def made(name: str, layers: frozenset[str] = frozenset()) -> Frame:
        def picture(own: Camera) -> View:
            read.append(name)
            return View(name, own, torch.full((3, 6, 8), float(ord(name))), mask=torch.ones(6, 8, dtype=torch.bool))

        return Frame(name, camera(), picture, layers=layers)

    frames = [made("a"), made("b"), made("c", frozenset({"mask"}))]
    read_view = lru_cache(2)(Frame.view)
    views = [Photograph(each, read_view) for each in frames]
    assert [view.name for view in views] == ["a", "b", "c"] and views[0].alpha is views[0].mask is None and not read
    for i in (0, 1, 0):
        assert views[i].image[0, 0, 0] == ord(views[i].name)
    assert read == ["a", "b"]
    assert views[2].mask is not None and views[2].image[0, 0, 0] == ord("c") and read == ["a", "b", "c"]
    assert views[0].image[0, 0, 0] == ord("a") and read == ["a", "b", "c"]
    assert views[1].image[0, 0, 0] == ord("b") and read == ["a", "b", "c", "b"]
    changed = views[1].with_image(views[1].image + 1)
    assert type(changed) is View and changed.name == "b" and changed.image[0, 0, 0] == ord("b") + 1
