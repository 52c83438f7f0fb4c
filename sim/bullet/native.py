"""PyBullet's C interface from compiled code: whole runs of physics steps without Python between them.

The same engine and the same numbers as through its module, which makes some hundred Python objects a physics step.
The module exports the interface but keeps its client handles to itself, in a function that only the library's symbol
table tells of; where a build has been stripped of it, ``find_client`` says so and the module does all the work.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import struct
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import types

TORQUE_CONTROL = 1
"""``b3ControlMode`` of that name."""
CONTACT_WORDS = 22
"""Size of ``b3ContactPointData``: five integers of 4 bytes (flags, two bodies, two links), then floats."""
FORCE = 13
"""Which word of it is the force along the normal, N."""
RUN_DTYPE = np.dtype(
    [
        ("client", "i8"),
        ("body", "i4"),
        ("position_index", "i4", (12,)),  # of each joint in the engine's generalised coordinates
        ("velocity_index", "i4", (12,)),
        ("friction", "f8"),  # N·m, dry
        ("sticking_speed", "f8"),  # below it the friction fades, rad/s
        ("raw", "f8", (49,)),  # as ``sensing.RAW`` says
        ("feet", "i4", (4,)),  # links
        ("touching", "u1", (5,)),  # feet, body
        ("answer", "i8", (7,)),
        ("contact", "f8", (CONTACT_WORDS,)),
    ],
    align=True,
)
"""A robot in the engine, and its state. Nothing here comes from another file: numba's cache looks at this one alone."""
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("at", "<u8"), ("size", "<u8")]
)
_ELF = b"\x7fELF\x02\x01"
"""How a library of 64 bits, low byte first, begins."""
_SYMBOL_TABLE = 2
_HIDDEN, _EXPORTED = b"getPhysicsClient", b"b3CanSubmitCommand"
_PLACE = types.intp  # a pointer
_INT, _FLOAT = types.int32, types.float64


def _outside(name: str, returns: types.Type, *takes: types.Type) -> Any:
    return types.ExternalFunction(name, returns(*takes))


_begin_control = _outside("b3JointControlCommandInit2", _PLACE, _PLACE, _INT, _INT)
_set_torque = _outside("b3JointControlSetDesiredForceTorque", _INT, _PLACE, _INT, _FLOAT)
_begin_step = _outside("b3InitStepSimulationCommand", _PLACE, _PLACE)
_begin_state = _outside("b3RequestActualStateCommandInit", _PLACE, _PLACE, _INT)
_submit = _outside("b3SubmitClientCommandAndWaitStatus", _PLACE, _PLACE, _PLACE)
_state_of = _outside("b3GetStatusActualState", _INT, *[_PLACE] * 8)
_begin_contacts = _outside("b3InitRequestContactPointInformation", _PLACE, _PLACE)
_filter_body = _outside("b3SetContactFilterBodyA", types.void, _PLACE, _INT)
_contacts_of = _outside("b3GetContactPointInformation", types.void, _PLACE, _PLACE)
_copy = _outside("memcpy", _PLACE, _PLACE, _PLACE, _PLACE)


@numba.njit(cache=True, error_model="numpy")
def _look(m):  # type: ignore[no-untyped-def]
    status = _submit(m.client, _begin_state(m.client, m.body))
    answer = m.answer.ctypes.data
    if status == 0:
        return False
    if _state_of(status, answer, answer + 8, answer + 16, answer + 24, answer + 32, answer + 40, answer + 48) == 0:
        return False
    raw, position, velocity = m.raw.ctypes.data, m.answer[4], m.answer[5]
    for i in range(12):
        _copy(raw + 8 * i, position + 8 * m.position_index[i], 8)
        _copy(raw + 8 * (12 + i), velocity + 8 * m.velocity_index[i], 8)
    _copy(raw + 8 * 36, position, 8 * 7)
    _copy(raw + 8 * 43, velocity, 8 * 6)
    return True


@numba.njit(cache=True, error_model="numpy")
def run(memory, law, peak, torques):  # type: ignore[no-untyped-def]
    """As many physics steps as ``torques`` (n, 12) N·m has rows, which are filled with what the motors exerted.

    Args:
        memory: bytes of one ``RUN_DTYPE``; its ``raw`` is the state before and afterwards.
        law: torque = constant - kp q - kd q̇, (3, 12).
        peak: where it is clipped, (12,) N·m; what acts on the joint is less by the dry friction.
        torques: output.

    Returns whether the engine answered.
    """
    m = memory.view(RUN_DTYPE)[0]
    raw = m.raw
    for step in range(len(torques)):
        control = _begin_control(m.client, m.body, TORQUE_CONTROL)
        for i in range(12):
            speed = raw[12 + i]
            torque = law[0, i] - law[1, i] * raw[i] - law[2, i] * speed
            if not -peak[i] < torque < peak[i]:
                torque = math.copysign(peak[i], torque)
            torques[step, i] = torque
            if -m.sticking_speed < speed < m.sticking_speed:
                torque -= speed * (m.friction / m.sticking_speed)
            else:
                torque -= math.copysign(m.friction, speed)
            _set_torque(control, m.velocity_index[i], torque)
        _submit(m.client, control)
        _submit(m.client, _begin_step(m.client))
        if not _look(m):
            return False
        raw[24:36] = torques[step]
    return True


@numba.njit(cache=True, error_model="numpy")
def look(memory):  # type: ignore[no-untyped-def]
    """Fill ``raw`` of the ``RUN_DTYPE`` in ``memory``, all but the torques. Returns whether the engine answered."""
    return _look(memory.view(RUN_DTYPE)[0])


@numba.njit(cache=True, error_model="numpy")
def touch(memory):  # type: ignore[no-untyped-def]
    """Fill ``touching`` of the ``RUN_DTYPE`` in ``memory``: feet that are pressed upon, then if the body touches."""
    m = memory.view(RUN_DTYPE)[0]
    m.touching[:] = 0
    request = _begin_contacts(m.client)
    _filter_body(request, m.body)
    _submit(m.client, request)
    _contacts_of(m.client, m.answer.ctypes.data)  # how many, of 4 bytes, and where they lie
    for index in range(m.answer.view(np.int32)[0]):
        _copy(m.contact.ctypes.data, m.answer[1] + 8 * CONTACT_WORDS * index, 8 * CONTACT_WORDS)
        link = m.contact.view(np.int32)[3]
        if link == -1:
            m.touching[4] = 1
        for leg in range(4):
            if link == m.feet[leg] and m.contact[FORCE] > 0.0:
                m.touching[leg] = 1


@lru_cache
def _places(library: Path) -> tuple[int, int] | None:
    """Where ``getPhysicsClient`` and an exported neighbour lie in the library; None where it does not tell."""
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as image:
        if image[:6] != _ELF:
            return None
        start, count = struct.unpack_from("<Q", image, 40)[0], struct.unpack_from("<H", image, 60)[0]
        sections = [struct.unpack_from("<IIQQQQIIQQ", image, start + 64 * index) for index in range(count)]
        for _, kind, _, _, offset, size, link, *_ in sections:
            if kind != _SYMBOL_TABLE:
                continue
            names = sections[link][4]
            symbols = np.frombuffer(image[offset : offset + size], _SYMBOL)
            found = [
                symbols["at"][symbols["name"] == image.find(b"\0" + name + b"\0", names) + 1 - names]
                for name in (_HIDDEN, _EXPORTED)
            ]
            if all(len(places) == 1 for places in found):
                return int(found[0][0]), int(found[1][0])
    return None


def find_client(library: Path, client: int) -> int:
    """Address of the client that PyBullet's module, loaded from ``library``, knows by a number; 0 if it hides it."""
    places = _places(library)
    if places is None:
        return 0
    llvm.load_library_permanently(str(library))
    exported = ctypes.cast(getattr(ctypes.CDLL(str(library)), _EXPORTED.decode()), ctypes.c_void_p).value
    assert exported is not None
    get_client = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(exported - places[1] + places[0])
    return get_client(client) or 0
