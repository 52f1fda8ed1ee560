"""EXR files: what is written is what is read, here and by another library."""

import json
import resource

import numpy as np
import OpenImageIO as oiio
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.image import drained, read_exr, read_metadata, read_rgb, write_exr

HEIGHT, WIDTH = 5, 7


@pytest.fixture
def layers():
    random = np.random.default_rng(1)
    sizes = {"beauty": 3, "alpha": 0, "depth": 0, "normal": 3, "albedo": 3, "emission": 3, "variance": 0, "sample_count": 0}
    return {
        name: random.standard_normal((HEIGHT, WIDTH, 3) if count else (HEIGHT, WIDTH)).astype(np.float32)
        for name, count in sizes.items()
    }


def test_every_channel_comes_back_bit_by_bit(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers)
    channels = read_exr(tmp_path / "a.exr")
    expected = {
        **dict(zip("RGB", np.moveaxis(layers["beauty"], -1, 0), strict=True)),
        "A": layers["alpha"],
        "depth.Z": layers["depth"],
        **{f"normal.{axis}": layers["normal"][..., i] for i, axis in enumerate("XYZ")},
        **{f"albedo.{axis}": layers["albedo"][..., i] for i, axis in enumerate("RGB")},
        **{f"emission.{axis}": layers["emission"][..., i] for i, axis in enumerate("RGB")},
        "variance.Y": layers["variance"],
        "samples.Y": layers["sample_count"],
    }
    assert channels.keys() == expected.keys()
    for name, plane in expected.items():
        assert channels[name].dtype == np.float32
        np.testing.assert_array_equal(channels[name], plane, err_msg=name)


def test_drained_layers_make_the_same_file_and_are_freed_one_by_one(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers)
    left, seen = dict(layers), []

    def watched():
        for name, layer in drained(left):
            seen.append((name, len(left)))
            yield name, layer

    write_exr(tmp_path / "b.exr", watched())
    assert seen == [(name, len(layers) - place) for place, name in enumerate(layers, start=1)]
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_strided_views_are_written_as_they_look(tmp_path, layers):
    wide = np.random.default_rng(2).random((2 * HEIGHT, 2 * WIDTH, 4)).astype(np.float32)
    layers = {"beauty": wide[::2, ::2, :3], "alpha": wide[::-2, ::2, 3], "depth": wide[::2, ::2, 0].astype(">f4")}
    write_exr(tmp_path / "a.exr", layers)
    channels = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.exr"), layers["beauty"])
    np.testing.assert_array_equal(channels["A"], layers["alpha"])
    np.testing.assert_array_equal(channels["depth.Z"], layers["depth"])


def test_another_reader_agrees(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers, {"scene": "fairy-lights", "spp": 64})
    buffer = oiio.ImageBuf(str(tmp_path / "a.exr"))
    names = buffer.spec().channelnames
    pixels = buffer.get_pixels(oiio.FLOAT)
    np.testing.assert_array_equal(pixels[..., names.index("normal.Y")], layers["normal"][..., 1])
    np.testing.assert_array_equal(pixels[..., names.index("R")], layers["beauty"][..., 0])
    assert buffer.spec().getattribute("scene") == "fairy-lights"
    assert buffer.spec().getattribute("spp") == 64


def test_metadata_comes_back(tmp_path, layers):
    settings = json.dumps({"mode": "lis-o", "camera": {"position": [0.0, -1.0, 1e-7]}, "name": "Straße"})
    facts = {"scene": "s", "mode": "lis-o", "spp": 3, "seed": 2**31 - 1, "software": "x 1", "settings": settings}
    write_exr(tmp_path / "a.exr", layers, facts)
    header = read_metadata(tmp_path / "a.exr")
    assert {name: header[name] for name in facts} == facts


def test_infinite_depth_survives(tmp_path):
    depth = np.full((3, 4), np.inf, dtype=np.float32)
    write_exr(tmp_path / "a.exr", {"depth": depth})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["depth.Z"], depth)


def test_half_floats_round_and_read_as_float32(tmp_path, layers):
    beauty = np.abs(layers["beauty"])
    write_exr(tmp_path / "a.exr", {"beauty": beauty}, half=True)
    read = read_rgb(tmp_path / "a.exr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, beauty.astype(np.float16).astype(np.float32))


def test_half_floats_refuse_what_they_cannot_hold(tmp_path):
    beauty = np.full((3, 4, 3), 7e4, dtype=np.float32)
    with pytest.raises(BokehguideError, match=r"a\.exr: R exceeds 65504"):
        write_exr(tmp_path / "a.exr", {"beauty": beauty}, half=True)
    assert not list(tmp_path.iterdir())


def test_unknown_layers_and_none_are_refused(tmp_path):
    with pytest.raises(BokehguideError, match=r"w\.exr: no layer is given; give at least one"):
        write_exr(tmp_path / "w.exr", {})
    with pytest.raises(BokehguideError, match=r"w\.exr: R is no layer; give beauty, alpha, "):
        write_exr(tmp_path / "w.exr", {"R": np.ones((2, 2), np.float32)})
    assert not list(tmp_path.iterdir())


def test_no_trace_of_a_write_that_fails(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers)
    before = (tmp_path / "a.exr").read_bytes()
    with pytest.raises(BokehguideError, match="unrecognized type of attribute 'scene'"):
        write_exr(tmp_path / "a.exr", layers, {"scene": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert (tmp_path / "a.exr").read_bytes() == before


def test_a_file_that_becomes_too_large_is_named_as_it_was_given(tmp_path, layers):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))  # as on a disk that is full
    try:
        with pytest.raises(BokehguideError) as refusal:
            write_exr(tmp_path / "a.exr", layers)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(refusal.value) == f"{tmp_path}/a.exr: cannot be written (File too large); choose another folder"
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written(tmp_path, layers):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(BokehguideError, match=r"file/a\.exr: cannot be written \(.*\); choose another folder"):
        write_exr(tmp_path / "file" / "a.exr", layers)


@pytest.mark.parametrize("keep", [3, 4, 40, 300, -20])
def test_truncated_files_are_named(tmp_path, layers, keep, capfd):
    write_exr(tmp_path / "a.exr", layers)
    (tmp_path / "b.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:keep])
    with pytest.raises(BokehguideError, match=r"^\S*b\.exr: is [^\n]*$"):
        read_rgb(tmp_path / "b.exr")
    assert capfd.readouterr() == ("", "")


def test_missing_file_folder_and_other_formats_are_named(tmp_path):
    (tmp_path / "text.exr").write_text("this is text")
    with pytest.raises(BokehguideError, match=r"text\.exr: is not an EXR file"):
        read_rgb(tmp_path / "text.exr")
    with pytest.raises(BokehguideError, match=r"none\.exr: cannot be read \(No such file"):
        read_rgb(tmp_path / "none.exr")
    with pytest.raises(BokehguideError, match=r"cannot be read \(Is a directory"):
        read_rgb(tmp_path)


def test_an_image_without_colour_is_named(tmp_path):
    write_exr(tmp_path / "a.exr", {"depth": np.ones((3, 4), np.float32), "alpha": np.ones((3, 4), np.float32)})
    with pytest.raises(BokehguideError, match=r"a\.exr: no channel R, G, B among A, depth\.Z"):
        read_rgb(tmp_path / "a.exr")
