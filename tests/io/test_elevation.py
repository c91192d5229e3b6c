"""Rasters of the ground: heights and photos, on local metres."""

import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.geometry.projection import ground_height
from torchvision_dddas.io.elevation import read_elevation, read_ortho

rasterio = pytest.importorskip("rasterio")
warp = pytest.importorskip("rasterio.warp")

ORIGIN = (-110.95, 32.23)
HERE = np.zeros((1, 2))


def centre(crs, origin=ORIGIN):
    (x,), (y,) = warp.transform("EPSG:4326", crs, [origin[0]], [origin[1]])
    return x, y


def write(path, values, crs="EPSG:32612", step=1.0, middle=None, **more):
    """A raster about a place in its own coordinates, by default ORIGIN. values: (R, C) or (B, R, C)."""
    values = np.atleast_3d(np.moveaxis(values, 0, -1)) if values.ndim == 3 else values[..., None]
    rows, columns, bands = values.shape
    x, y = middle or centre(crs)
    corner = rasterio.transform.from_origin(x - columns * step / 2, y + rows * step / 2, step, step)
    shape = {"height": rows, "width": columns, "count": bands, "dtype": str(values.dtype)}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=corner, **shape, **more) as file:
        file.write(np.moveaxis(values, -1, 0))
    return path


def slope(crs="EPSG:32612", step=1.0, cells=201, base=1300.0):
    """Heights that rise by 0.1 m a metre to the north of the grid and 0.05 m to its east."""
    k = (np.arange(cells) - cells // 2) * step
    return (base + 0.05 * k[None] - 0.1 * k[:, None]).astype("float32")


def test_heights_are_relative_to_the_origin_and_lie_where_they_belong(tmp_path):
    found = read_elevation(write(tmp_path / "a.tif", slope()), HERE, ORIGIN, margin_m=60)
    assert found.base_m == pytest.approx(1300, abs=1e-3)
    places = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [-30.3, 25.7]])
    # The grid's north is turned by a third of a degree against true north here.
    x, y = np.array(warp.transform("EPSG:4326", "EPSG:32612", *lonlat(places, ORIGIN).T)) - np.array(
        [[v] for v in centre("EPSG:32612")]
    )
    np.testing.assert_allclose(ground_height(found, places), 0.05 * x + 0.1 * y, atol=2e-3)


def test_a_raster_in_degrees_gives_the_same_heights(tmp_path):
    step = 1e-5
    cells, tall = 301, 1300.0
    k = np.arange(cells) - cells // 2
    heights = (tall - 0.1 * k[:, None] * step * 110_900 + 0 * k[None]).astype("float32")
    found = read_elevation(write(tmp_path / "a.tif", heights, "EPSG:4326", step), HERE, ORIGIN, margin_m=60)
    assert ground_height(found, np.array([[0.0, 50.0]]))[0] == pytest.approx(5.0, abs=0.01)


def test_local_metres_without_an_origin_are_those_of_the_raster(tmp_path):
    path = write(tmp_path / "a.tif", slope(), None, middle=(500.0, 700.0))
    found = read_elevation(path, np.array([[500.0, 700.0]]), None, margin_m=60)
    first, second = ground_height(found, np.array([[500.0, 700.0], [520.0, 730.0]]))
    assert second - first == pytest.approx(0.05 * 20 + 0.1 * 30, abs=1e-3)


@pytest.mark.parametrize("declared", [{"nodata": -9999.0}, {}])
def test_holes_are_unknown_whether_declared_or_not(tmp_path, declared):
    heights = slope()
    heights[40:60, 100:160] = -9999.0 if declared else -32768.0
    found = read_elevation(write(tmp_path / "a.tif", heights, **declared), HERE, ORIGIN, margin_m=80)
    row = np.array([[30.0, 50.0]])
    assert np.isnan(ground_height(found, row))
    known = found.up_m[np.isfinite(found.up_m)]
    assert known.min() > -20


def test_where_the_origin_is_not_covered_up_is_counted_from_the_landmarks(tmp_path):
    x, y = centre("EPSG:32612")
    path = write(tmp_path / "a.tif", slope(base=900.0), middle=(x + 300, y))
    places = np.array([[0.0, 0.0], [280.0, 0.0], [320.0, 0.0]])
    found = read_elevation(path, places, ORIGIN, margin_m=50)
    assert np.isnan(ground_height(found, places[:1]))
    assert ground_height(found, places[1:]).mean() == pytest.approx(0, abs=0.1)
    assert found.base_m == pytest.approx(900, abs=0.5)


def test_a_fine_raster_is_averaged_down(tmp_path):
    heights = np.full((800, 800), 100, "float32")
    heights[::2] += 1
    found = read_elevation(write(tmp_path / "a.tif", heights, step=0.01), HERE, ORIGIN, margin_m=200)
    inside = found.up_m[np.isfinite(found.up_m)]
    assert found.step_m == pytest.approx(0.2)
    assert np.abs(inside).max() < 0.3
    assert found.base_m == pytest.approx(100.5, abs=0.3)


def text(path):
    path.write_text("no raster")
    return path


def bare_picture(path):
    cv2.imwrite(str(path), np.full((20, 20), 90, np.uint8))
    return path


BANDS = np.zeros((3, 20, 20), "uint8")


@pytest.mark.filterwarnings("error", "ignore::PendingDeprecationWarning")
@pytest.mark.parametrize(
    ("read", "make", "origin", "words"),
    [
        (read_elevation, lambda p: write(p, slope()), (2.0, 48.0), r"covers longitude -110\.95.*landmarks lie at east"),
        (read_elevation, text, ORIGIN, "cannot be read as a raster"),
        (read_elevation, lambda p: p, ORIGIN, "cannot be read as a raster"),
        (read_elevation, lambda p: write(p, BANDS), ORIGIN, "3 bands; give one"),
        (read_elevation, lambda p: write(p, slope(), None, middle=(0.0, 0.0)), ORIGIN, "no CRS"),
        (read_elevation, lambda p: write(p, slope(), "EPSG:4326", 1e-5), None, "the landmarks in local metres"),
        (read_elevation, bare_picture, None, "does not say where it lies"),
        (read_ortho, lambda p: write(p, slope()), ORIGIN, "1 bands of float32; give a photo"),
        (read_ortho, lambda p: write(p, BANDS), (2.0, 48.0), "it has no data there"),
    ],
)
def test_what_is_no_such_raster_or_lies_elsewhere_is_refused_in_one_line(tmp_path, read, make, origin, words):
    path = make(tmp_path / "a.tif")
    with pytest.raises(InputError, match=words) as error:
        read(path, HERE, origin)
    assert str(path) in str(error.value)


@pytest.fixture
def requests():
    """The paths that a server was asked for, after its address."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *args):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        asked.append(f"http://127.0.0.1:{server.server_address[1]}")
        yield asked
        server.shutdown()
        thread.join(10)


def vrt(address, side):
    source = f"<SourceFilename>/vsicurl/{address}</SourceFilename><SourceBand>1</SourceBand>"
    return (
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><SRS>EPSG:32612</SRS><GeoTransform>0,1,0,0,0,-1'
        '</GeoTransform><VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f"{source}</SimpleSource></VRTRasterBand></VRTDataset>"
    )


def name_overviews(path, address):
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{address}")


_BESIDE = '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/{}</MDI></Metadata></PAMDataset>'
_LARGE = 4100  # cells a side: more than are read of it


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("text.tif", "cannot be read as a raster"),
        ("overviews.tif", ""),
        ("beside.tif", ""),
        ("inside.tif", "in another file"),
        ("/vsicurl/{}", "no such file"),
        ("{}", "no such file"),
    ],
)
def test_a_raster_never_makes_a_request(tmp_path, requests, name, words):
    address = f"{requests.pop()}/{name.strip('{}/')}"
    path = tmp_path / name if name.endswith(".tif") else name.format(address)
    if name == "text.tif":
        path.write_text(vrt(address, 20))
    elif name.endswith(".tif"):
        write(path, np.ones((_LARGE, _LARGE), np.uint8), tiled=True, compress="deflate")
    if name == "overviews.tif":
        path.with_suffix(".tif.ovr").write_text(vrt(address, _LARGE // 2))
    if name == "beside.tif":
        path.with_suffix(".tif.aux.xml").write_text(_BESIDE.format(address))
    if name == "inside.tif":
        name_overviews(path, address)
    if words:
        with pytest.raises(InputError, match=words):
            read_elevation(path, HERE, ORIGIN, margin_m=2050)
    else:
        assert np.nanmax(read_elevation(path, HERE, ORIGIN, margin_m=2050).up_m) == 0
    assert requests == []


def test_without_rasterio_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(InputError, match=r"needs rasterio: pip install 'torchvision-dddas\[elevation\]'"):
        read_elevation(tmp_path / "a.tif", HERE, ORIGIN)


def test_a_photo_shows_each_place_in_its_colour(tmp_path):
    photo = np.full((3, 200, 200), 90, "uint8")
    photo[0, :100, 100:] = 250  # red in the north-east
    found = read_ortho(write(tmp_path / "a.tif", photo, step=0.5), HERE, ORIGIN, margin_m=40)
    pixel_from_place = np.linalg.inv(np.vstack([found.east_north_from_pixel, [0, 0, 1]]))
    for place, blue_green_red in (((20, 20), (90, 90, 250)), ((-20, 20), (90, 90, 90)), ((20, -20), (90, 90, 90))):
        u, v, _ = np.rint(pixel_from_place @ [*place, 1]).astype(int)
        assert found.image[v, u].tolist() == list(blue_green_red)


def test_a_white_band_of_a_photo_is_no_hole(tmp_path):
    photo = np.full((3, 60, 60), 90, "uint8")
    photo[0, 28:32, 28:32] = 255
    photo[:, :10] = 255
    found = read_ortho(write(tmp_path / "a.tif", photo, nodata=255), HERE, ORIGIN, margin_m=20)
    middle = found.image.shape[0] // 2
    assert found.image[middle, middle].tolist() == [90, 90, 255]


@pytest.mark.parametrize("of", ["strip", "tile", "overview"])
def test_a_raster_whose_strips_or_tiles_take_too_much_memory_is_refused(tmp_path, monkeypatch, of):
    path, side = tmp_path / "a.tif", 64 if of == "overview" else 512
    blocks = {"tiled": of != "strip", "blockysize": side, "compress": "deflate"}
    write(path, slope(cells=1024), **blocks, **({"blockxsize": side} if of != "strip" else {}))
    if of == "overview":
        with rasterio.Env(GDAL_TIFF_OVR_BLOCKSIZE=512), rasterio.open(path, "r+") as file:
            file.build_overviews([2])
    assert read_elevation(path, HERE, ORIGIN, margin_m=60).base_m == pytest.approx(1300, abs=0.2)
    monkeypatch.setenv("DDDAS_MEMORY_MB", "1")
    with pytest.raises(InputError, match=r"a\.tif has strips or tiles of (512|1024)x512 cells; that takes [12] MB of"):
        read_elevation(path, HERE, ORIGIN, margin_m=60)


@pytest.mark.parametrize("side", [30_000, 29_999])
def test_a_raster_of_one_huge_strip_in_a_file_of_bytes_is_refused(tmp_path, side):
    path = tmp_path / "a.tif"
    shape = {"height": side, "width": side, "count": 1, "dtype": "float32", "blockysize": side, "sparse_ok": True}
    shape["compress"] = "deflate"  # libtiff reads a strip that is not compressed in parts
    corner = rasterio.transform.from_origin(*centre("EPSG:32612"), 1, 1)
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:32612", transform=corner, **shape):
        pass
    assert path.stat().st_size < 1000
    for read_it in (read_elevation, read_ortho):
        with pytest.raises(InputError, match=f"has strips or tiles of {side}x{side} cells; that takes 3,600 MB of"):
            read_it(path, HERE, ORIGIN)
