"""Announced sizes are held against real ones before anything of that size is allocated."""

import io
import json
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from spt_jax.files.archives import read_npz
from spt_jax.files.limits import TooLargeError, as_file, file_errors, read_bytes, read_json
from spt_jax.io.poses.containers import open_container
from spt_jax.keypoints import read_keypoints
from spt_jax.show.overlay import read_image


def npy(array, shape=None, descr=None):
    """The bytes of an .npy, with another shape or dtype announced."""
    header = {
        "descr": np.lib.format.dtype_to_descr(array.dtype) if descr is None else descr,
        "fortran_order": False,
        "shape": array.shape if shape is None else shape,
    }
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, header)
    return content.getvalue() + array.tobytes()


def zipped(path, packed=zipfile.ZIP_DEFLATED, **members):
    with zipfile.ZipFile(path, "w", packed) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_they_were(tmp_path, rng, save):
    arrays = {
        "plain": rng.normal(size=(4, 3)),
        "single": rng.normal(size=(4, 3)).astype(np.float32),
        "fortran": np.asfortranarray(rng.normal(size=(2, 3, 4))),
        "number": np.array(3),
        "text": np.array(["a", "bc"]),
        "none": np.zeros((0, 3)),
        "bool": np.array([True, False]),
    }
    save(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz")
    assert found.names == list(arrays)
    for name, array in arrays.items():
        assert found.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(found.arrays[name], array)
    assert list(read_npz(tmp_path / "a.npz", {"text"}.__contains__).arrays) == ["text"]
    found.arrays["plain"][0] = 1  # as np.load gives it


@pytest.mark.parametrize(
    ("shape", "descr"), [((10**12, 3), None), ((10**30,), None), ((3,), "<U0"), ((3,), "<f4")]
)
def test_a_shape_that_the_bytes_do_not_have_is_refused_before_it_is_allocated(
    tmp_path, shape, descr
):
    file = zipped(tmp_path / "a.npz", poses=npy(np.zeros((5, 3)), shape, descr))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"poses in .*a\.npz cannot be read: it announces"):
        read_npz(file)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_well_packed_arrays_count_by_what_they_unpack_to(tmp_path):
    file = zipped(tmp_path / "a.npz", poses=npy(np.zeros((10**6,), np.float16)))
    assert file.stat().st_size < 10_000
    with pytest.raises(TooLargeError, match=r"poses in .*4,000,000 bytes: got 8,000,000; if the"):
        read_npz(file, max_bytes=4_000_000)
    assert read_npz(file, max_bytes=8_000_000).arrays["poses"].shape == (10**6,)
    two = zipped(tmp_path / "b.npz", a=npy(np.zeros(600)), b=npy(np.zeros(600)))
    with pytest.raises(TooLargeError, match="arrays up to b in"):
        read_npz(two, max_bytes=9_000)
    # Entries without bytes cost memory all the same once something is made of them.
    empty = zipped(tmp_path / "c.npz", a=npy(np.zeros(0, "<U1"), (10**15,), "<U0"))
    with pytest.raises(TooLargeError, match="a in"):
        read_npz(empty)


def test_a_member_that_lies_about_its_own_size_is_refused(tmp_path):
    file = zipped(tmp_path / "a.npz", poses=npy(np.zeros((5, 3))))
    content = bytearray(file.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + 24 : entry + 28] = struct.pack("<I", 4_000_000_000)
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"poses in .* announces 4,000,000,000 bytes packed into"):
        read_npz(file)


def test_damaged_archives_are_one_kind_of_error(tmp_path, rng):
    whole = zipped(tmp_path / "a.npz", poses=npy(rng.normal(size=(50, 3)))).read_bytes()
    for seed in range(150):
        rng = np.random.default_rng(seed)
        content = bytearray(whole)
        for place in rng.integers(0, len(whole), 4):
            content[place] = rng.integers(256)
        if seed % 3 == 0:
            content = content[: rng.integers(len(whole))]
        (tmp_path / "b.npz").write_bytes(content)
        try:
            read_npz(tmp_path / "b.npz")
        except ValueError as error:
            assert "b.npz" in str(error)
    long = npy(np.zeros(3))
    zipped(tmp_path / "c.npz", a=long[:6] + b"\x02\x00" + b"\xff\xff\xff\x7f" + long[10:])
    with pytest.raises(ValueError, match="its header announces 2,147,483,647 bytes"):
        read_npz(tmp_path / "c.npz")
    zipped(tmp_path / "d.npz", zipfile.ZIP_LZMA, a=long)
    with pytest.raises(ValueError, match="packed in a way that NumPy does not use"):
        read_npz(tmp_path / "d.npz")
    np.savez(tmp_path / "e.npz", a=np.array({}, dtype=object))
    with pytest.raises(ValueError, match=r"a in .*e\.npz is an object array"):
        read_npz(tmp_path / "e.npz")
    with zipfile.ZipFile(tmp_path / "f.npz", "w") as archive:
        archive.writestr("a.npy", long)
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.npy", long)
    with pytest.raises(ValueError, match="must hold a once"):
        read_npz(tmp_path / "f.npz")


def test_json_is_read_within_limits_and_never_too_deep(tmp_path):
    file = tmp_path / "a.json"
    file.write_text("\ufeff" + json.dumps({"people": [[1, 2.5]]}), encoding="utf-8")
    assert read_json(file) == {"people": [[1, 2.5]]}
    with pytest.raises(TooLargeError, match=r"keypoint file .*a\.json' must not take more than 9"):
        read_json(file, "keypoint file", max_bytes=9)
    for content, message in (
        (b"[" * 200_000, "must not be nested so deeply"),
        (b"[1, 2", "at line 1, column 6; it is cut or damaged"),
        (b"\xff\xfe[", "bytes that are no text at position 0"),
        (b"[" + b"9" * 5000 + b"]", "must be JSON"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.json.*{message}|{message}.*a\.json"):
            read_json(file)
    file.write_bytes(b"[" + b"[]," * 100_000 + b"[]]")
    with pytest.raises(TooLargeError, match="lists of JSON file"):
        read_json(file, max_bytes=400_000)


def test_what_is_no_regular_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mesh file must exist: got '.*none"):
        as_file(tmp_path / "none", "mesh file")
    with pytest.raises(ValueError, match="got the folder"):
        as_file(tmp_path)
    with pytest.raises(ValueError, match="got the device or pipe"):
        as_file("/dev/null")
    with pytest.raises(OSError, match=r"file must be readable: got 'a+' "):
        as_file("a" * 5000)
    assert read_bytes(__file__).startswith(b'"""Announced')
    with pytest.raises(ValueError, match="max_bytes must be positive: got 0"):
        read_bytes(__file__, max_bytes=0)


def test_a_small_file_is_read_without_room_for_the_limit(tmp_path):
    file = tmp_path / "small"
    file.write_bytes(b"abc")
    tracemalloc.start()
    content = read_bytes(file)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert content == b"abc" and peak < 2**22
    assert len(read_bytes("/proc/self/maps")) > 2  # which announces a size of 0


def test_errors_get_their_file(tmp_path):
    full = pytest.raises(ValueError, match=r"mesh file must fit into memory: got 'a\.ply'")
    with full, file_errors("mesh file", "a.ply"):
        raise MemoryError
    broken = pytest.raises(OSError, match=r"mesh file must be readable: got 'a.ply' \(bad disk\)")
    with broken, file_errors("mesh file", "a.ply"):
        raise OSError(5, "bad disk")


def png(width, height, rows=b""):
    """A picture of the announced size, with as many bytes as given."""

    def chunk(kind, content):
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packed = chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + packed + chunk(b"IEND", b"")


def test_images_are_not_unpacked_beyond_the_limit(tmp_path):
    file = tmp_path / "a.png"
    file.write_bytes(png(3, 2, b"\0\1\2\3" * 2))
    assert read_image(file).tolist() == [[[1] * 3, [2] * 3, [3] * 3]] * 2
    for side in (2_000_000_000, 12_000):
        file.write_bytes(png(side, side))
        with pytest.raises(ValueError, match=r"a\.png"):
            read_image(file, max_bytes=10**8)
    with pytest.raises(TooLargeError, match=r"image .*a\.png' must not take more than 100,000,000"):
        read_image(file, max_bytes=10**8)
    (tmp_path / "a.eps").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    with pytest.raises(ValueError, match=r"a photograph that opens: got .*a\.eps"):
        read_image(tmp_path / "a.eps")


def test_damaged_images_are_refused_by_name(tmp_path, rng):
    picture = Image.fromarray(rng.integers(0, 255, (9, 9, 3), np.uint8))
    for suffix in ("png", "jpg", "tif", "webp", "bmp"):
        file = tmp_path / f"a.{suffix}"
        picture.save(file)
        whole = file.read_bytes()
        for _ in range(40):
            content = bytearray(whole)
            for place in rng.integers(0, len(whole), 3):
                content[place] = rng.integers(256)
            file.write_bytes(content[: rng.integers(len(whole))] if rng.random() < 0.3 else content)
            try:
                assert read_image(file).ndim == 3
            except ValueError as error:
                assert file.name in str(error)


@pytest.mark.parametrize("place", ["first letter", "suffix"])
def test_a_damaged_name_in_the_list_of_members_is_not_passed_over(place, tmp_path):
    """Scores under a damaged name were left out without a word; the fuzz found it."""
    path = tmp_path / "a.npz"
    np.savez(path, keypoints=np.ones((1, 17, 2)), keypoint_scores=np.full((1, 17), 0.5))
    content = path.read_bytes()
    at = content.rindex(b"keypoint_scores.npy") + (0 if place == "first letter" else 15)
    path.write_bytes(content[:at] + b"\0" + content[at + 1 :])
    for read in (read_npz, read_keypoints, open_container):
        with pytest.raises(ValueError, match=r"(?s)a\.npz.*File name in directory"):
            read(path)


def test_a_header_that_is_cut_off_within_brackets_is_named(tmp_path):
    """Python's own tokenizer refuses it, with an error of its own kind."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3L,"
    header = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("pose.npy", header + b"\0" * 24)
    with pytest.raises(ValueError, match=r"pose in .*a\.npz"):
        read_npz(tmp_path / "a.npz")
