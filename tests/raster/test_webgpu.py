"""The WebGPU kernels against the definition: on whatever adapter there is, a program on the CPU
included."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.raster.backends import rasteriser_of
from stages.raster.definition import Arrays, MemoryFull, RasterSettings, splat_arrays
from stages.raster.draw import renderer
from stages.raster.reference_rasteriser import ReferenceRasteriser
from stages.raster.webgpu import device
from stages.raster.webgpu.rasteriser import WebGpuRasteriser
from tests.extremes.gpu import on_gpu
from tests.extremes.table import ROWS, measured
from tests.raster import hostile_values as hostile
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

pytestmark = pytest.mark.skipif(bool(device.missing()), reason=device.missing())
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
SIZES = [(1, 1), (17, 1), (47, 33), (83, 61)]
# rows of the extremes table that take a second or two; `python -m tests.extremes.gpu` does all
HEAVY_ROWS = (1, 18, 20, 27, 31)


def poison(rasteriser: WebGpuRasteriser) -> None:
    """What buffers held before must not matter."""
    for buffer in rasteriser.scratch._buffers.values():
        rasteriser.device.send(np.full(buffer.size // 4, np.nan, np.float32), buffer)


def same_as_reference(arrays: Arrays, view, settings=SETTINGS) -> None:
    """Pictures, what is visible, every gradient and contributions."""
    found, wanted = WebGpuRasteriser(), ReferenceRasteriser()
    other = splat_arrays(cloud(90, 70, 50, degree=1))
    found.backward(found.forward(other, camera(70, 50), SETTINGS), np.ones((3, 50, 70), np.float32))
    poison(found)
    a = found.forward(arrays, view, settings, depths=True)
    b = wanted.forward(arrays, view, settings, depths=True)
    np.testing.assert_allclose(a.image[:4], b.image[:4], atol=FLOAT32_IMAGE)
    np.testing.assert_allclose(a.image[4], b.image[4], atol=10 * FLOAT32_IMAGE)
    assert np.isclose(a.image[5], b.image[5], atol=10 * FLOAT32_IMAGE).mean() > 0.999
    np.testing.assert_array_equal(a.visible, b.visible)
    assert a.culled == b.culled
    v = np.random.default_rng(1).normal(size=(3, view.height, view.width)).astype(np.float32)
    g, h = found.backward(a, v), wanted.backward(b, v)
    assert g.parameters.shape == h.parameters.shape
    for first, end in ((0, 3), (3, 7), (7, 10), (10, 11), (11, None)):
        assert relative(g.parameters[:, first:end], h.parameters[:, first:end]) < FLOAT32_GRADIENT
    assert relative(g.means2d, h.means2d) < FLOAT32_GRADIENT
    for column, wanted_column in zip(
        found.contributions(a, v).T, wanted.contributions(b, v).T, strict=True
    ):
        assert relative(column, wanted_column) < FLOAT32_GRADIENT


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("size", SIZES)
def test_pictures_and_every_gradient_agree(size, degree):
    settings = RasterSettings(background=(0.2, 0.5, 0.9), antialias=degree % 2 == 0)
    scene = cloud(250, size[0], size[1], degree, seed=degree)
    same_as_reference(splat_arrays(scene), camera(*size), settings)


@pytest.mark.parametrize("antialias", [False, True])
def test_the_smoothing_filter_agrees(antialias):
    scene = cloud(80, degree=1)
    widths = np.random.default_rng(3).uniform(0, 0.3, 80).astype(np.float32)
    same_as_reference((*splat_arrays(scene), widths), camera(), RasterSettings(antialias=antialias))


def test_a_turned_off_centre_camera_agrees():
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(0.4), 0, np.sin(0.4)], [0, 1, 0], [-np.sin(0.4), 0, np.cos(0.4)]]
    turn[:3, 3] = (0.5, -0.3, 1.0)
    view = camera(70, 50, cx=-20.0, cy=-12.0, matrix=turn)
    same_as_reference(splat_arrays(cloud(400, degree=2)), view)


@pytest.mark.parametrize("n", [0, 1])
def test_few_splats_and_none_agree(n):
    same_as_reference(splat_arrays(cloud(n, degree=1)), camera())


def test_gradients_of_an_active_degree_leave_higher_bands_alone():
    scene, view, settings = cloud(30, 24, 20, degree=2), camera(24, 20), RasterSettings(sh_degree=1)
    v = np.random.default_rng(1).normal(size=(20, 24, 3)).astype(np.float32)
    found = gradients("webgpu", scene, view, v, settings)
    wanted = exact_gradients(scene, view, v, settings)
    assert not found["sh"][:, 4:].any()
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) < FLOAT32_GRADIENT, name


def test_the_same_twice_is_the_same_bytes():
    arrays, view = splat_arrays(cloud(300, 90, 70, degree=1)), camera(90, 70)
    v = np.random.default_rng(1).normal(size=(3, 70, 90)).astype(np.float32)
    made = []
    for _ in range(2):
        rasteriser = WebGpuRasteriser()
        forward = rasteriser.forward(arrays, view, SETTINGS)
        gradient = rasteriser.backward(forward, v).parameters
        made.append((forward.image.tobytes(), gradient.tobytes()))
    assert made[0] == made[1]


def test_pictures_of_the_same_splats_send_them_once(monkeypatch):
    sent, send = [], WebGpuRasteriser.scene

    def counting(self, arrays):
        sent.append(arrays)
        return send(self, arrays)

    monkeypatch.setattr(WebGpuRasteriser, "scene", counting)
    draw = renderer(cloud(20, 40, 30), SETTINGS, "webgpu")
    pictures = [draw(camera(40, 30)).image for _ in range(2)]
    assert len(sent) == 1
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_lists_without_room_draw_what_they_hold_and_say_how_much_it_was():
    rasteriser = WebGpuRasteriser()
    scene = rasteriser.scene(splat_arrays(cloud(40, 40, 30)))
    view, images, totals = rasteriser.view(camera(40, 30), SETTINGS), [], []
    for capacity in (None, 10, 1000):
        drawn = rasteriser.draw(scene, view, capacity=capacity)
        images.append(rasteriser.device.read(drawn.image, np.float32, 4 * view.pixels))
        totals.append(int(rasteriser.device.read(drawn.lists.ends, np.uint32, 1, len(scene))[0]))
    assert len(set(totals)) == 1
    assert totals[0] > 10
    assert np.isfinite(images[1]).all()
    np.testing.assert_array_equal(images[0], images[2])


@pytest.mark.parametrize("n", [1, 64, 1025, 70_000])
def test_a_sort_is_stable_and_knows_where_each_key_was(n):
    rasteriser = WebGpuRasteriser()
    keys = np.random.default_rng(n).integers(0, 2**32 if n > 64 else 3, n, np.uint32)
    for bits in (4, 12, 32):
        part = keys & np.uint32(2**bits - 1)
        found = rasteriser._sorted("test", rasteriser.device.sent(part), n, bits)
        order = np.argsort(part, kind="stable")
        for buffer, wanted in zip(found, (part[order], order), strict=True):
            np.testing.assert_array_equal(rasteriser.device.read(buffer, np.uint32, n), wanted)


def test_sums_go_through_three_levels_and_do_not_overflow():
    rasteriser, n = WebGpuRasteriser(), 2**20 + 5
    values = np.random.default_rng(0).integers(0, 100, n, np.uint32)
    for largest in (100, 2**31):
        values[-3:] = largest
        buffer = rasteriser.device.sent(values)
        rasteriser._scan(buffer, n)
        wanted = np.concatenate([[0], np.cumsum(values, dtype=np.uint64)[:-1]])
        found = rasteriser.device.read(buffer, np.uint32, n)
        np.testing.assert_array_equal(found, np.minimum(wanted, 2**32 - 1))


def rows():
    for row in filter(on_gpu, ROWS):
        marks = [pytest.mark.slow] if row.number in HEAVY_ROWS else []
        yield pytest.param(row, id=row.name, marks=marks)


@pytest.mark.parametrize("row", list(rows()))
def test_every_number_of_the_table_is_within_its_bound(row):
    beyond = [m for m in measured(row, "webgpu") if not m.accepted]
    assert not beyond, "\n".join(f"{m.what}: {m.error:.3g} > {m.bound:.3g}" for m in beyond)


@pytest.mark.slow
@pytest.mark.parametrize("slot", PARAMETERS)
def test_hostile_values_corrupt_nothing_else(slot):
    """See `hostile_values.check_hostile`."""
    for component in range(hostile.components(slot)):
        for value in (*hostile.EXTREMES, *hostile.near_threshold(slot), *hostile.NOT_NUMBERS):
            a, b = (
                hostile.check_hostile(name, slot, component, value)
                for name in ("webgpu", "reference")
            )
            assert a.culled == b.culled, (component, value)
            assert relative(a.image, b.image) <= FLOAT32_IMAGE, (component, value)


def test_splats_that_no_buffer_holds_are_refused_with_how_many_would_fit():
    most = device.require().largest
    with pytest.raises(MemoryFull) as caught, device.errors_explained(10**9):
        device.require().empty(2**33)
    assert caught.value.fits == most // 256


def test_a_lost_device_is_an_error_and_not_a_traceback():
    lost = device.Device(device._adapter())
    buffer = lost.empty(10)
    lost.wgpu.destroy()
    with pytest.raises(SplatError, match="lost") as caught, device.errors_explained(1):
        lost.read(buffer, np.float32, 10)
    assert caught.value.code == "raster-webgpu-failed"


def test_a_machine_without_an_adapter_is_told_what_to_do(monkeypatch):
    monkeypatch.setattr(device, "missing", lambda: "no adapter")
    with pytest.raises(SplatError, match="no adapter") as caught:
        rasteriser_of("webgpu")
    assert caught.value.code == "raster-no-webgpu"
    assert "--backend cpu" in caught.value.hint
