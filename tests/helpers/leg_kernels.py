"""Kernels that evaluate the kinematics of legs, one thread per leg and robot; legs of all robots are equal."""

import importlib

import warp as wp


def make_leg_kernel(package):
    """Return a kernel that evaluates the functions of `kinematics.leg` at joint angles and ankle velocities."""
    names = ("kinematics.five_bar", "kinematics.geometry", "scalar", "kinematics.leg")
    five_bar, geometry, scalar, leg_kinematics = (importlib.import_module(f"{package}.{name}") for name in names)
    real, vec2, vec3 = scalar.real, scalar.vec2, scalar.vec3

    @wp.kernel(module="unique", enable_backward=False)
    def leg_kernel(
        legs: wp.array(dtype=geometry.LegGeometry), motors: wp.array2d(dtype=real), ankle_vel: wp.array2d(dtype=vec3),
        ankle: wp.array2d(dtype=vec3), knees: wp.array2d(dtype=vec2),
        motor_rates: wp.array2d(dtype=vec3), knee_rates: wp.array2d(dtype=vec2),
    ):  # fmt: skip
        """Write the outputs of `Build.legs_at`; launch over (4, n). motors [rad]: (12, n); ankle_vel [m/s]: (4, n)."""
        k, i = wp.tid()
        geo = legs[k]
        angles = vec3(motors[3 * k, i], motors[3 * k + 1, i], motors[3 * k + 2, i])
        ankle[k, i] = leg_kinematics.leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
        loop = five_bar.five_bar(geo, angles[1], angles[2])
        knees[k, i] = leg_kinematics.knee_angles(geo, loop, angles[1], angles[2])
        rates = leg_kinematics.leg_inverse_velocity(geo, angles, ankle_vel[k, i])
        motor_rates[k, i] = rates
        outer_shank_rate = loop.outer_shank_do * rates[1] + loop.outer_shank_di * rates[2]
        inner_shank_rate = loop.inner_shank_do * rates[1] + loop.inner_shank_di * rates[2]
        knee_rates[k, i] = vec2(rates[1] + geo.front * outer_shank_rate, rates[2] - geo.front * inner_shank_rate)

    return leg_kernel


def make_inverse_kernel(package):
    """Return a kernel that writes motors [rad] (12, n) for paws [m] (4, n), body frame; launch over (4, n)."""
    names = ("kinematics.inverse", "kinematics.geometry", "scalar")
    inverse, geometry, scalar = (importlib.import_module(f"{package}.{name}") for name in names)

    @wp.kernel(module="unique", enable_backward=False)
    def inverse_kernel(
        legs: wp.array(dtype=geometry.LegGeometry), limits: inverse.LegLimits, paws: wp.array2d(dtype=scalar.vec3),
        motors: wp.array2d(dtype=scalar.real),
    ):  # fmt: skip
        """Write the results of `clamped_closed_form`."""
        k, i = wp.tid()
        found = inverse.clamped_closed_form(legs[k], limits, paws[k, i] - legs[k].hip)
        for joint in range(3):
            motors[3 * k + joint, i] = found[joint]

    return inverse_kernel
