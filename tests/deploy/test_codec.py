"""Frames of the motors against cantools, which reads the DBC file."""

import cantools
import numpy as np
import pytest

from jumper_warp.deploy.codec import ENTER, EXIT, ZERO, Codec, dbc

KINDS = ("AK80-9", "AK70-10", "AK70-10")
COUNT = 33_334  # frames of each of three motors: 1e5 each way


@pytest.fixture(scope="module")
def database():
    """cantools' database of one bus."""
    return cantools.database.load_string(dbc(KINDS), "dbc")


def test_commands_are_bit_equal_to_cantools(database):
    codec = Codec(KINDS * COUNT)
    commands = np.random.default_rng(0).uniform(codec.lower, codec.upper)
    commands[2] = np.minimum(commands[2], 499.8)  # kp stays one step below its full scale
    messages = [database.get_message_by_frame_id(i + 1) for i in range(3)]
    names = ("position", "velocity", "kp", "kd", "torque")
    rows = (dict(zip(names, values, strict=True)) for values in commands.T.tolist())
    expected = [messages[i % 3].encode(row) for i, row in enumerate(rows)]
    assert codec.encode(commands).tobytes() == b"".join(expected)


def test_replies_are_bit_equal_to_cantools(database):
    data = np.random.default_rng(1).integers(0, 256, size=(3 * COUNT, 8)).astype(np.uint8)
    data[:, 0] = np.tile([1, 2, 3], COUNT)
    reply = Codec(KINDS * COUNT).decode_reply(data)
    read = [database.decode_message(0, frame.tobytes()) for frame in data]
    for name in ("position", "velocity", "temperature", "error"):
        assert getattr(reply, name).tolist() == [each[name] for each in read]
    assert reply.torque.tolist() == [each[f"torque_{each['motor']}"] for each in read]


def test_replies_encode_to_what_they_were_decoded_from():
    codec = Codec(KINDS)
    data = np.random.default_rng(2).integers(0, 256, size=(1000, 3, 8)).astype(np.uint8)
    ids = np.array([1, 2, 3])
    data[:, :, 0] = ids
    assert all((codec.encode_reply(ids, codec.decode_reply(frames)) == frames).all() for frames in data)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("size", [1.0e3, 1.0e30, np.inf])
def test_commands_saturate(sign, size):
    codec = Codec(KINDS)
    decoded = codec.decode_command(codec.encode(np.full((5, 3), sign * size)))
    expected = np.where(sign > 0.0, codec.upper, codec.lower)
    assert np.abs(decoded - expected).max() < 0.123  # kp stays one step below its full scale


def test_nan_is_refused():
    commands = np.zeros((5, 3))
    commands[3, 1] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        Codec(KINDS).encode(commands)


def test_no_command_is_a_special_frame():
    codec = Codec(KINDS)
    near_full_scale = codec.upper * np.linspace(0.99, 1.01, 2001)[:, None, None]
    frames = {data.tobytes() for command in near_full_scale for data in codec.encode(command)}
    assert not frames & {ENTER, EXIT, ZERO}
    # the special frames have the code 0xFFF of kp, bytes 3 (low half) and 4, which no command reaches
    assert all((frame[3] & 15, frame[4]) == (15, 255) for frame in (ENTER, EXIT, ZERO))
    assert codec.largest[2].max() == 0xFFE
