"""Unitree's messages: bytes, checksum, what cyclonedds announces, tables of motors, the remote, and what is refused in words."""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant

from legged_mw import ROOT, unitree
from legged_mw.deploy import __main__ as deploy
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.robot import BUTTONS
from legged_mw.unitree import handset, idl, link
from legged_mw.unitree.codec import LAYOUTS, STRUCTS, WireMessage, crc32, decode_remote, encode_remote, fields
from legged_mw.unitree.faults import KINDS, Faults, parse_faults
from legged_mw.unitree.robots import G1, GO2, H1, check_body, machine_of, order
from legged_mw.utils.cli import one_line_errors
from tests.wires import POLICIES
from tests.wires import domain as domain


def test_types_are_announced_as_the_robots_announce_them() -> None:
    """Another hash makes Unitree's own programs, on the robot too, ask for the type and crash on the answer."""
    assert idl.hashes() == idl.HASHES
    assert idl.wrong_hash() == ""


def test_each_interface_has_its_domain() -> None:
    assert (link.default_domain("lo"), link.default_domain("eth0")) == (1, 0)


def test_an_end_of_the_wire_leaves_though_a_cycle_held_it(domain: int) -> None:
    """Else whoever has the domain next in this process counts two robots."""
    end = link.RobotEnd("unitree_go", "lo", domain)
    end.itself = end  # type: ignore[attr-defined]
    del end
    gc.collect()
    participant = link.join("lo", domain)
    there = [each for each in BuiltinDataReader(participant, BuiltinTopicDcpsParticipant).take(9) if each is not None]
    assert [each.key for each in there] == [participant.guid]


# ---- bytes


def filled(key: tuple[str, str], rng: np.random.Generator) -> Any:
    """A sample of cyclonedds' own, with a number in every field."""
    package, made = key[0], {}
    for name, kind, count in fields(*key):
        values = [
            filled((package, kind), rng) if kind in STRUCTS[package] else _number(kind, rng) for _ in range(count or 1)
        ]
        made[name] = values[0] if count is None else values
    return idl.TYPES[key](**made)


def _number(kind: str, rng: np.random.Generator) -> float:
    if kind == "float32":
        return float(np.float32(rng.normal()))
    return int(rng.integers(0, {"byte": 256, "int16": 2**15}.get(kind, 2**16)))


def flat(sample: Any) -> list[float]:
    """Its numbers in the order of the fields."""
    if dataclasses.is_dataclass(sample):
        return [x for field in dataclasses.fields(sample) for x in flat(getattr(sample, field.name))]
    return [x for each in sample for x in flat(each)] if isinstance(sample, list) else [sample]


@pytest.mark.parametrize(
    ("key", "size"), [(("unitree_go", "LowCmd_"), 812), (("unitree_hg", "LowState_"), 2092)], ids=str
)
def test_bytes_are_those_of_the_generic_codec(key: tuple[str, str], size: int) -> None:
    """Field by field: what cyclonedds' own codec writes is read by name, and the other way round."""
    sample, layout = filled(key, np.random.default_rng(1)), LAYOUTS[key]
    data = bytes(sample.serialize())
    assert len(data) == layout.size + 4 == size
    message, copy = WireMessage(layout, data[4:]), WireMessage(layout)
    for name in layout.index:
        copy[name] = message[name]
    assert copy.body == data[4:] == idl.RAW[key](copy.body).serialize()[4:]
    motor = "motor_cmd" if "LowCmd_" in key else "motor_state"
    assert np.array_equal(message[f"{motor}.q"], [each.q for each in getattr(sample, motor)])
    assert np.array_equal(message[f"{motor}.mode"], [each.mode for each in getattr(sample, motor)])
    assert idl.RAW[key].deserialize(data).body == data[4:]


@pytest.mark.parametrize("key", LAYOUTS, ids=str)
def test_every_layout_is_the_generic_codecs(key: tuple[str, str]) -> None:
    sample, layout = filled(key, np.random.default_rng(2)), LAYOUTS[key]
    message = WireMessage(layout, bytes(sample.serialize())[4:])
    values = np.concatenate([np.ravel(message[name]) for name in layout.index])
    assert sorted(values.tolist()) == sorted(flat(sample))


def bitwise(image: np.ndarray) -> int:
    """The checksum as Unitree's sources describe it."""
    crc = 0xFFFFFFFF
    for word in image.view("<u4").tolist():
        for bit in range(31, -1, -1):
            top = crc >> 31
            crc = (crc << 1) & 0xFFFFFFFF
            if top:
                crc ^= 0x04C11DB7
            if word >> bit & 1:
                crc ^= 0x04C11DB7
    return crc


def test_the_checksum() -> None:
    image = np.random.default_rng(3).integers(0, 256, 64, dtype=np.uint8)
    assert crc32(image) == bitwise(image)


@pytest.mark.parametrize(
    ("key", "size"), [(k, s) for k, s in zip(LAYOUTS, (812, 1180, 1004, 2092), strict=True)], ids=str
)
def test_it_is_taken_of_the_struct_not_of_the_wire(key: tuple[str, str], size: int) -> None:
    """The compiler pads where the wire does not: a field that is set must lie where C++ has it."""
    layout = LAYOUTS[key]
    message = WireMessage(layout)
    assert layout.image_size == size and not message.intact()
    message.seal()
    assert message.intact()
    name = "motor_cmd.kd" if key[1] == "LowCmd_" else "motor_state.tau_est"
    message[name] = np.arange(len(message[name]))
    assert not message.intact()


def test_a_known_checksum() -> None:
    """A command of G1, all motors on, kp 60, computed bit by bit over the struct as gcc lays it out."""
    message = WireMessage(LAYOUTS["unitree_hg", "LowCmd_"])
    message["mode_machine"], message["motor_cmd.mode"], message["motor_cmd.kp"] = 5, 1, 60.0
    motor = np.zeros((35, 28), dtype=np.uint8)
    motor[:, 0] = 1
    motor[:, 16:20] = np.frombuffer(np.float32(60.0).tobytes(), dtype=np.uint8)
    image = np.concatenate([np.array([0, 5, 0, 0], dtype=np.uint8), motor.ravel(), np.zeros(16, dtype=np.uint8)])
    assert message.checksum() == bitwise(image)


def test_a_message_of_another_size() -> None:
    with pytest.raises(ValueError, match="a message of 3 bytes, not 808"):
        WireMessage(LAYOUTS["unitree_go", "LowCmd_"], b"abc")


# ---- motors and the remote


def test_motors_by_name() -> None:
    assert (
        list(GO2.motors)[:4] == ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint"]
        and len(GO2.motors) == 12
    )
    assert [
        G1.motors[f"{name}_joint"]
        for name in ("left_knee", "right_hip_pitch", "waist_pitch", "left_elbow", "right_wrist_yaw")
    ] == [*(3, 6, 14, 18, 28)]
    assert [
        H1.motors[f"{name}_joint"]
        for name in ("right_knee", "torso", "left_ankle", "right_shoulder_pitch", "left_elbow")
    ] == [*(2, 6, 10, 12, 19)]
    assert (9 not in H1.motors.values(), len(H1.motors), len(G1.motors)) == (True, 19, 29)
    for name, machine in (("go2_flat", GO2), ("g1_flat", G1)):
        joints = read_contract(POLICIES / name).joints
        assert machine_of(joints[::-1]) is machine
        assert order(machine, joints[::-1]).tolist() == order(machine, joints).tolist()[::-1]
    assert order(GO2, ["FL_hip_joint", "FR_hip_joint"]).tolist() == [3, 0]


def test_the_contracts_body_passes_and_other_machines_have_no_choice() -> None:
    check_body(G1, 5)
    check_body(GO2, 77)


def test_the_remote() -> None:
    data = encode_remote(["A", "L2"], lx=0.25, ly=0.5, rx=-1.0, ry=0.125)
    assert len(data) == 40 and data[2:4] == (1 << 8 | 1 << 5).to_bytes(2, "little")
    assert np.frombuffer(data, "<f4", offset=4)[[0, 1, 2, 4]].tolist() == [0.25, -1.0, 0.125, 0.5]
    remote = decode_remote(data)
    assert (
        remote
        and remote.buttons == {"A", "L2"}
        and (remote.lx, remote.ly, remote.rx, remote.ry) == (0.25, 0.5, -1.0, 0.125)
    )
    assert decode_remote(bytes(40)) is None
    for i, name in enumerate(BUTTONS):
        assert encode_remote([name])[2:4] == (1 << i).to_bytes(2, "little")


def test_a_script_of_the_remote(tmp_path: Path) -> None:
    (tmp_path / "remote.yaml").write_text(
        "remote: [{time: 2, ly: 0.5}, {time: 1, press: start}, {time: 3, lx: -1, hoist: false}]"
    )
    hand = handset.Handset(handset.load_remote(tmp_path / "remote.yaml"))
    states = [decode_remote(hand.state(time)) for time in (0.0, 1.0, 1.09, 1.2, 2.5, 3.0)]
    assert [(set(s.buttons), s.ly, s.lx) for s in states if s] == [
        *((set(), 0, 0), ({"start"}, 0, 0), ({"start"}, 0, 0), (set(), 0, 0), (set(), 0.5, 0), (set(), 0.5, -1))
    ]
    assert hand.hoist is False


JOINTS = ["FL_hip_joint", "FL_calf_joint"]


def test_faults_on_demand() -> None:
    """In the order of their times; "off" ends one."""
    faults, found = (
        Faults(),
        parse_faults(
            ["silent@2,silent=off@3", "loss=5,joint_order,motor_fault=FL_calf_joint@1.5", "hot_motor=90"], JOINTS
        ),
    )
    assert [(fault.text, fault.time) for fault in found] == [
        *(
            ("loss=5", 0),
            ("joint_order", 0),
            ("hot_motor=90", 0),
            ("motor_fault=FL_calf_joint@1.5", 1.5),
            ("silent@2", 2),
            ("silent=off@3", 3),
        )
    ]
    for fault in found[:-1]:
        fault.begin(faults)
    assert faults == Faults(loss=0.05, joint_order=1, temperature=90.0, dead_motors={"FL_calf_joint"}, silent=True)
    found[-1].begin(faults)
    assert not faults.silent
    for fault in parse_faults(["motor_fault=FL_hip_joint"], JOINTS):
        fault.begin(faults)
    assert faults.dead_motors == {"FL_calf_joint", "FL_hip_joint"}
    for fault in parse_faults(["motor_fault=off"], JOINTS):
        fault.begin(faults)
    assert not faults.dead_motors
    page = (ROOT / "docs/faults.md").read_text()
    assert [name for name in KINDS if f"`{name}" not in page] == []


def test_without_the_extra_one_command_installs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(unitree, "find_spec", lambda name: None)
    for flag in ("--robot", "--serve"):
        monkeypatch.setattr(sys, "argv", ["legged_mw.deploy", "go2_flat", flag, "unitree", "--interface", "lo"])
        with pytest.raises(SystemExit, match="2"), one_line_errors("legged_mw.deploy"):
            deploy.main()
        error = capsys.readouterr().err
        assert (
            "Unitree's robots speak DDS, which needs cyclonedds: pip install 'legged_mw[unitree]'\n" in error
            and error.count("\n") == 1
        )
    assert importlib.util.find_spec("cyclonedds")


def test_nothing_of_dds_is_imported_by_the_program() -> None:
    """Only by who asks for such a robot."""
    code = "import sys, legged_mw.deploy.__main__; print([name for name in sys.modules if name.partition('.')[0] == 'cyclonedds'])"
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )
