"""A public client that is not the vendor's, against the emulators: rustypot, if it is installed.

It was written in Rust from the manuals, independently of the vendors' SDKs that our lines use.
"""

import numpy as np
import pytest

from support.servo_servers import bench_of, on_a_port, still_dynamixels, still_servos

rustypot = pytest.importorskip("rustypot")

CENTRE, RAD = 2048, 4096 / (2 * np.pi)


@pytest.mark.wall_clock
@pytest.mark.parametrize(
    ("kind", "controller", "unit", "zero"),
    [
        ("dynamixel", "Xl330PyController", 1 / RAD, CENTRE),
        ("dynamixel", "Xl430PyController", 1, 0),
        ("feetech", "Sts3215PyController", 1 / RAD, CENTRE),
    ],
)
def test_another_client_reads_writes_and_groups(kind, controller, unit, zero):
    servos = still_servos(ids=[1, 2]) if kind == "feetech" else still_dynamixels([1, 2])
    bench_of(servos).counts.update({1: CENTRE + 400, 2: CENTRE - 400})
    with on_a_port(servos) as server:
        client = getattr(rustypot, controller)(str(server.device), 1_000_000, 0.5)
        assert client.ping(1) and client.ping(2) and not client.ping(9)
        positions = np.ravel(client.sync_read_present_position([1, 2]))
        counts = np.array([CENTRE + 400, CENTRE - 400])
        np.testing.assert_allclose(positions, (counts - zero) * unit, atol=1e-6)
        client.write_torque_enable(1, True)
        assert np.ravel(client.read_torque_enable(1))[0] and servos._get(1, "torque_enable") == 1
        wanted = np.array([CENTRE + 300, CENTRE - 150])
        client.sync_write_goal_position([1, 2], ((wanted - zero) * unit).tolist())
        # answered only after the goals, which are not acknowledged
        assert np.ravel(client.sync_read_present_position([1, 2])).size == 2
        goals = [servos._get(servo, "goal_position") for servo in (1, 2)]
        np.testing.assert_allclose(goals, wanted, atol=1)
