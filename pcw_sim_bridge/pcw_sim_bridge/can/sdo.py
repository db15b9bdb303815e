"""The questions and answers of CANopen's service data objects (CiA 301, section 7.2.4), as steps of a procedure.

`canopen` has the same as a call that blocks with a thread beside it. Steps can be asked of eight drives at once, and in
simulated time; the tests put `canopen`'s own server and client at the other end.
"""

from __future__ import annotations

import struct
from collections.abc import Generator

from .drive import Ask
from .errors import DriveError
from .frame import Frame

REQUEST, RESPONSE = 0x600, 0x580
ABORT = 0x80
ABORT_CODES = {
    0x05040001: "command not known", 0x06010000: "access not supported", 0x06010001: "write only", 0x06010002: "read only",
    0x06020000: "no such object", 0x06040041: "cannot be mapped", 0x06040042: "too much is mapped", 0x06040043: "incompatible",
    0x06070010: "wrong length", 0x06090011: "no such sub-index", 0x06090030: "value out of range", 0x08000000: "general error",
    0x08000022: "not in this state",
}  # fmt: skip


class SdoAbort(DriveError):
    """The drive refused an object."""


def upload(joint: str, node: int, index: int, sub: int = 0) -> Generator[Ask, Frame | None, bytes]:
    """Read an object and return its bytes.

    Raises:
        DriveError: no answer.
        SdoAbort: the drive refuses.
    """
    what = f"0x{index:04X}:{sub}"
    request = struct.pack("<BHB4x", 0x40, index, sub)
    answer = yield _ask(node, request, what, index, sub)
    data = _checked(answer, joint, what)
    if data[0] & 0x02:  # expedited
        size = 4 - ((data[0] >> 2) & 3) if data[0] & 0x01 else 4
        return data[4 : 4 + size]
    collected, toggle = b"", 0
    while True:
        answer = yield _ask_segment(node, struct.pack("<B7x", 0x60 | toggle), what)
        data = _checked(answer, joint, what)
        if (data[0] & 0x10) != toggle:
            raise DriveError(f"{joint}: {what} came with a segment twice; allowed: segments that alternate")
        collected += data[1 : 8 - ((data[0] >> 1) & 7)]
        if data[0] & 0x01 or len(collected) > 256:
            return collected
        toggle ^= 0x10


def download(joint: str, node: int, index: int, sub: int, value: int, size: int) -> Generator[Ask, Frame | None, None]:
    """Write an object of 1, 2 or 4 bytes.

    Raises:
        DriveError: no answer.
        SdoAbort: the drive refuses.
    """
    what = f"0x{index:04X}:{sub} = {value}"
    data = (value & ((1 << (8 * size)) - 1)).to_bytes(size, "little")
    request = struct.pack("<BHB", 0x23 | ((4 - size) << 2), index, sub) + data.ljust(4, b"\0")
    _checked((yield _ask(node, request, what, index, sub)), joint, what)


def _ask(node: int, request: bytes, what: str, index: int, sub: int) -> Ask:
    wanted = struct.pack("<HB", index, sub)

    def accept(frame: Frame) -> bool:
        return frame.id == RESPONSE + node and len(frame.data) == 8 and frame.data[1:4] == wanted

    return Ask(Frame(REQUEST + node, request), accept, what)


def _ask_segment(node: int, request: bytes, what: str) -> Ask:
    def accept(frame: Frame) -> bool:
        return frame.id == RESPONSE + node and len(frame.data) == 8

    return Ask(Frame(REQUEST + node, request), accept, what, tries=1)


def _checked(answer: Frame | None, joint: str, what: str) -> bytes:
    if answer is None:
        raise DriveError(f"{joint}: {what} has no answer; allowed: a drive that is on, on this bus, with this node id")
    if answer.data[0] == ABORT:
        code = struct.unpack("<I", answer.data[4:])[0]
        raise SdoAbort(f"{joint}: {what} is refused by the drive: {ABORT_CODES.get(code, 'abort')} (0x{code:08X})")
    return answer.data
