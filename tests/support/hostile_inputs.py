"""Hostile inputs by kind: frames, messages, images and archives, damaged or made to cost much."""

import io
import random
import tarfile
import zipfile
import zlib

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.mutants import damaged, image_files, png_bomb, png_header, png_of
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence_proto.v1 import depth_pb2 as pb

_ODD = (0.0, -1.0, 5e-324, 1e300, float("inf"), float("-inf"), float("nan"))
_ODD_SIZES = ((0, 0), (1, 1), (64, 49), (48, 64), (30_000, 30_000), (2**32 - 1, 2**32 - 1))
_IMAGES = {
    pb.IMAGE_ENCODING_PNG: image_files()["png"],
    pb.IMAGE_ENCODING_JPEG: image_files()["jpeg"],
}
_ROOM = dict(sequence_files(make_frames(2)))


def frame(chance: random.Random, frame_id: int) -> bytes:
    """Return a request with a frame in which something is wrong, most of the time."""
    message = frame_message(make_frame(frame_id))
    fields = message.frame
    if chance.random() < 0.6:
        encoding = chance.choice([*_IMAGES])
        for side in (fields.left, fields.right):
            side.encoding, side.data = encoding, _IMAGES[encoding]
    side = chance.choice((fields.left, fields.right))
    match chance.randrange(10):
        case 0 | 1 | 2 | 3:
            side.data = damaged(side.data, chance)
        case 4:
            side.encoding = pb.IMAGE_ENCODING_PNG
            side.data = png_bomb(chance.choice((0x7FFFFFFF, 0xC0000000, 1 << 28)))
        case 5:
            side.width, side.height = chance.choice(_ODD_SIZES)
        case 6:
            pose = fields.pose.world_from_left
            part = chance.choice((pose.orientation, pose.position_m))
            setattr(part, chance.choice("xyz"), chance.choice(_ODD))
        case 7:
            fields.max_age_s = chance.choice(_ODD)
        case 8:
            fields.frame_id = chance.choice((0, 1, 2**64 - 1))
        case 9:
            return damaged(message.SerializeToString(), chance)
    return message.SerializeToString()


def opening(chance: random.Random) -> bytes:
    """Return the bytes of a first message that is damaged, a bomb, or asks for much."""
    message = open_message(every=chance.random() < 0.5)
    cameras = (message.open.rig.left, message.open.rig.right)
    match chance.randrange(8):
        case 0:  # one message, then another, and so on
            return b"\x0a\x00\x12\x00" * (1 << chance.randrange(4, 20))
        case 1:  # fields that nobody knows
            return b"\xf2\x06\x00" * (1 << chance.randrange(4, 20))
        case 2:
            size = chance.choice(((61, 65_535), (4_000_000, 1), (4096, 960), (1, 1), (0, 5)))
            for camera in cameras:
                camera.width, camera.height = size
        case 3:
            setattr(cameras[0], chance.choice(("fx", "fy", "cx", "cy")), chance.choice(_ODD))
        case 4:
            for camera in cameras:
                camera.distortion = chance.choice(
                    [pb.DISTORTION_NONE, pb.DISTORTION_BROWN_CONRADY, pb.DISTORTION_KANNALA_BRANDT]
                )
                camera.coefficients.extend([chance.choice(_ODD)] * chance.randrange(6))
        case 5:
            message.open.stream_id = chance.choice(("../..", "x" * 200, "a/b", "\r\n"))
        case 6:
            message.open.resume_token = chance.randbytes(16)
        case 7:
            pass
    data = message.SerializeToString()
    return damaged(data, chance) if chance.random() < 0.5 else data


def flat_frame(width: int, height: int) -> tuple[pb.StreamDepthRequest, pb.StreamDepthRequest]:
    """Return an opening and a frame of few bytes whose step is as large as the limits allow."""
    open_request = open_message(every=False)
    for camera in (open_request.open.rig.left, open_request.open.rig.right):
        camera.width, camera.height = width, height
        camera.cx, camera.cy = (width - 1) / 2, (height - 1) / 2
    row = b"\0" + bytes(3 * width)
    png = png_of(png_header(width, height), (b"IDAT", zlib.compress(row * height)), (b"IEND", b""))
    image = pb.Image(encoding=pb.IMAGE_ENCODING_PNG, width=width, height=height, data=png)
    request = pb.StreamDepthRequest(frame=pb.Frame(frame_id=1, left=image, right=image))
    return open_request, request


def archive(chance: random.Random) -> tuple[str, bytes]:
    """Return the media type and the bytes of an upload that is damaged or hostile."""
    files = dict(_ROOM)
    match chance.randrange(8):
        case 0 | 1:  # a damaged file inside
            name = chance.choice([*files])
            files[name] = damaged(files[name], chance)
        case 2:
            files[chance.choice(("../../x", "/etc/x", "C:\\x", "n" * 300, "a\0b"))] = b"x"
        case 3:
            return "application/zip", _zip_bomb(chance)
        case 4:
            return "application/gzip", _tar_of_folders(chance)
        case 5:
            files["calib.json"] = b"[" * (1 << chance.randrange(4, 17))
        case 6:
            files["poses.txt"] = (b"nan " * 12 + b"\n") * (1 << chance.randrange(2, 14))
        case 7:
            files["frame_0001_gt.npz"] = _array_bomb()
    packed = zip_bytes(files.items())
    if chance.random() < 0.4:
        packed = damaged(packed, chance)
    return "application/zip", packed


def pair(chance: random.Random) -> dict[str, bytes]:
    """Return the files of a form, of which one is damaged, another kind, or a bomb."""
    kinds = [*image_files().values()]
    files = {"left": chance.choice(kinds), "right": chance.choice(kinds)}
    side = chance.choice([*files])
    match chance.randrange(4):
        case 0 | 1:
            files[side] = damaged(files[side], chance)
        case 2:
            files[side] = png_bomb(0xC0000000)
        case 3:
            files[side] = png_of(png_header(30_000, 30_000), (b"IDAT", b"x"), (b"IEND", b""))
    return files


def message_of_any_kind(chance: random.Random) -> bytes:
    """Return the bytes of a small message that is damaged, unknown or large."""
    match chance.randrange(3):
        case 0:
            return chance.randbytes(chance.randrange(200))
        case 1:
            return b"\xf2\x06\x00" * (1 << chance.randrange(4, 18))
        case _:
            return damaged(pb.GetStreamRequest(stream_id="s" * 40).SerializeToString(), chance)


def _zip_bomb(chance: random.Random) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for index in range(chance.randrange(1, 4)):
            file.writestr(f"{index}.bin", bytes(1 << chance.randrange(16, 24)))
    return packed.getvalue()


def _tar_of_folders(chance: random.Random) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz", compresslevel=1) as file:
        for index in range(1 << chance.randrange(2, 11)):
            info = tarfile.TarInfo(f"folder{index}")
            info.type = chance.choice((tarfile.DIRTYPE, tarfile.DIRTYPE, tarfile.SYMTYPE))
            info.pax_headers = {"comment": "x" * chance.randrange(200)}
            file.addfile(info)
    return packed.getvalue()


def _array_bomb() -> bytes:
    header = str({"descr": "<u2", "fortran_order": False, "shape": (1 << 20, 1 << 16)}).encode()
    start = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n"
    return zip_bytes([("disp.npy", start)])
