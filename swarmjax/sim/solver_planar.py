"""Contacts of the planar body on the GPU: projected Gauss-Seidel, one thread an arena.

A contact of two hulls, or of a hull and a box, only pushes, along one direction (condim 1), and the
planar body's inertia is diagonal: its centre of mass lies on its yaw axis. MuJoCo's convex problem
for the forces of contacts in its dual form (MuJoCo's documentation, Computation, "Dual problem"),

    minimise over f >= 0:  1/2 f' (J M^-1 J' + R) f + f' (J a0 - aref),

has as many unknowns as there are contacts, mostly none, and MuJoCo's own second solver, PGS, goes
through them one by one. MJX-Warp has Newton's method alone, which factorises a matrix of 3 R rows
for every arena at every iteration. Both end at the same forces: there is one minimum.

Nothing else acts on this body but what is applied to it (`qfrc_applied`): no gravity along its
joints, no spring, damper or actuator, and no Coriolis force, with the centre of mass on the axis.
So `step` leaves out what MJX-Warp works out for those, and the inertia matrix with it.
"""

from typing import Any

import mujoco.mjx.third_party.mujoco_warp as mjw
import warp as wp

NUMBER = 0  # what `opt.solver` says: MuJoCo's own of PGS, which MJX-Warp does not know
# Share of the largest force by which any may still change; float32 rounds at 1e-7.
TOLERANCE = wp.constant(1e-6)


def step(m: Any, d: Any) -> None:
    """Moves all arenas of planar robots on by one physics step (MuJoCo's semi-implicit Euler).

    Args:
      m: Warp's model: bodies that slide along x and y and turn about their centre of mass, or
        stand; contacts of condim 1.
      d: Warp's data of all arenas, written to.
    """
    mjw.fwd_kinematics(m, d)
    mjw.collision(m, d)
    mjw.make_constraint(m, d)
    motion = Motion()
    motion.mobility = wp.empty((d.nworld, m.nv), dtype=float)
    motion.smooth, motion.qacc, motion.warmstart = d.qacc_smooth, d.qacc, d.qacc_warmstart
    motion.qfrc = d.qfrc_constraint
    wp.launch(
        _accelerate,
        dim=(d.nworld, m.nv),
        inputs=[m.dof_bodyid, m.body_dofadr, m.body_mass, m.body_inertia, d.qfrc_applied, motion],
    )
    wp.launch(
        _push_apart,
        dim=d.nworld,
        inputs=[_sides(m, d), _contacts(m, d), motion, m.opt.iterations, d.solver_niter],
    )
    mjw.euler(m, d)


@wp.struct
class Motion:
    """How the joints of all arenas move, [A, V].

    Attributes:
      mobility: diagonal of M^-1.
      smooth: acceleration without contacts.
      warmstart: acceleration of the step before.
      qacc: acceleration with contacts.
      qfrc: forces of contacts.
    """

    mobility: wp.array2d[float]
    smooth: wp.array2d[float]
    warmstart: wp.array2d[float]
    qacc: wp.array2d[float]
    qfrc: wp.array2d[float]


@wp.struct
class Sides:
    """What contacts are between.

    Attributes:
      geom: [C] the two geoms of each contact of all arenas.
      frame: [C] its axes in rows, the first from one geom to the other.
      pos: [C] where it is, m.
      body: [G] of a geom.
      joint: [B] the first joint of a body; -1 of what stands.
      xpos: [A, B] of a body, m.
    """

    geom: wp.array[wp.vec2i]
    frame: wp.array[wp.mat33]
    pos: wp.array[wp.vec3]
    body: wp.array[int]
    joint: wp.array[int]
    xpos: wp.array2d[wp.vec3]


@wp.struct
class Row:
    """A row of the Jacobian J, and what else does not change from sweep to sweep.

    Attributes:
      first: joint x of the robot that is pushed back; -1: none.
      second: joint x of the one that is pushed ahead; -1: none.
      first_slope: entries of J at x, y and yaw of the first.
      second_slope: likewise.
      give: entry of R.
      stiffness: what a unit of force brings about, J M^-1 J' + R.
    """

    first: int
    second: int
    first_slope: wp.vec3
    second_slope: wp.vec3
    give: float
    stiffness: float


@wp.struct
class Contacts:
    """The contacts of all arenas.

    Attributes:
      count: [A] how many.
      id: [A, N] which of all contacts each is.
      D: [A, N] 1 / R.
      aref: [A, N] acceleration along the normal that is asked for.
      row: [A, N] of the Jacobian.
      force: [A, N] f.
    """

    count: wp.array[int]
    id: wp.array2d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    row: wp.array2d[Row]
    force: wp.array2d[float]


def _sides(m: Any, d: Any) -> Any:
    """Gathers what contacts are between."""
    sides = Sides()
    sides.geom, sides.frame, sides.pos = d.contact.geom, d.contact.frame, d.contact.pos
    sides.body, sides.joint, sides.xpos = m.geom_bodyid, m.body_dofadr, d.xpos
    return sides


def _contacts(m: Any, d: Any) -> Any:
    """Gathers the contacts."""
    contacts = Contacts()
    contacts.count, contacts.id, contacts.force = d.nefc, d.efc.id, d.efc.force
    contacts.D, contacts.aref = d.efc.D, d.efc.aref
    contacts.row = wp.empty((d.nworld, d.njmax), dtype=Row)
    return contacts


@wp.kernel(enable_backward=False)
def _accelerate(
    dof_body: wp.array[int],
    joint: wp.array[int],
    mass: wp.array2d[float],
    inertia: wp.array2d[wp.vec3],
    applied: wp.array2d[float],
    motion: Motion,
) -> None:
    """Acceleration of a joint by what is applied to it; none of it is by contacts yet."""
    arena, dof = wp.tid()
    body = dof_body[dof]
    mobility = 1.0 / mass[arena % mass.shape[0], body]
    if dof - joint[body] == 2:  # yaw, after x and y
        mobility = 1.0 / inertia[arena % inertia.shape[0], body][2]
    motion.mobility[arena, dof] = mobility
    motion.smooth[arena, dof] = mobility * applied[arena, dof]
    motion.qacc[arena, dof] = mobility * applied[arena, dof]
    motion.qfrc[arena, dof] = 0.0


@wp.kernel(enable_backward=False)
def _push_apart(
    sides: Sides, contacts: Contacts, motion: Motion, sweeps: int, niter: wp.array[int]
) -> None:
    """Finds the forces of an arena's contacts and what comes of them."""
    arena = wp.tid()
    count = wp.min(contacts.count[arena], contacts.force.shape[1])
    for i in range(count):
        row = _row(sides, motion, arena, contacts.id[arena, i], contacts.D[arena, i])
        contacts.row[arena, i] = row
        # The force that the contact would have at the acceleration of the step before.
        short = contacts.aref[arena, i] - _along(row, motion.warmstart, arena)
        contacts.force[arena, i] = wp.max(short / row.give, 0.0)
        _push(row, motion, arena, contacts.force[arena, i])
    done = wp.int32(0)
    moves = count > 0
    while moves and done < sweeps:
        moves = _sweep(contacts, motion, arena, count)
        done += 1
    niter[arena] = done
    if count > 0:
        _finish(contacts, motion, arena, count)


@wp.func
def _row(sides: Sides, motion: Motion, arena: int, contact: int, weight: float) -> Row:
    """Works out the row of a contact."""
    row = Row()
    geoms = sides.geom[contact]
    first, second = sides.body[geoms[0]], sides.body[geoms[1]]
    row.first = sides.joint[first]
    row.second = sides.joint[second]
    row.first_slope = -_slope(sides, arena, contact, first)
    row.second_slope = _slope(sides, arena, contact, second)
    row.give = 1.0 / weight
    row.stiffness = row.give + _response(motion, arena, row.first, row.first_slope)
    row.stiffness += _response(motion, arena, row.second, row.second_slope)
    return row


@wp.func
def _slope(sides: Sides, arena: int, contact: int, body: int) -> wp.vec3:
    """Speed of a body along the normal, where it touches, by its speeds along x, y and yaw."""
    frame = sides.frame[contact]
    normal = wp.vec3(frame[0, 0], frame[0, 1], frame[0, 2])
    arm = wp.cross(sides.pos[contact] - sides.xpos[arena, body], normal)
    return wp.vec3(normal[0], normal[1], arm[2])


@wp.func
def _response(motion: Motion, arena: int, joint: int, slope: wp.vec3) -> float:
    """Acceleration along the normal that a unit of force along it gives a robot."""
    return wp.dot(slope, wp.cw_mul(_at(motion.mobility, arena, joint), slope))


@wp.func
def _at(of_joints: wp.array2d[float], arena: int, joint: int) -> wp.vec3:
    """What a robot has at its joints x, y and yaw; 0 of what stands."""
    found = wp.vec3()
    if joint >= 0:
        found[0] = of_joints[arena, joint]
        found[1] = of_joints[arena, joint + 1]
        found[2] = of_joints[arena, joint + 2]
    return found


@wp.func
def _along(row: Row, acceleration: wp.array2d[float], arena: int) -> float:
    """J a: how fast the two sides accelerate apart."""
    apart = wp.dot(row.first_slope, _at(acceleration, arena, row.first))
    return apart + wp.dot(row.second_slope, _at(acceleration, arena, row.second))


@wp.func
def _push(row: Row, motion: Motion, arena: int, force: float) -> None:
    """Adds what a force brings about, a += M^-1 J' f."""
    _push_robot(motion, arena, row.first, force * row.first_slope)
    _push_robot(motion, arena, row.second, force * row.second_slope)


@wp.func
def _push_robot(motion: Motion, arena: int, joint: int, push: wp.vec3) -> None:
    """Adds forces along x and y and a torque to those on a robot."""
    if joint >= 0:
        for axis in range(3):
            dof = joint + axis
            kick = motion.mobility[arena, dof] * push[axis]
            motion.qacc[arena, dof] = motion.qacc[arena, dof] + kick
            motion.qfrc[arena, dof] = motion.qfrc[arena, dof] + push[axis]


@wp.func
def _sweep(contacts: Contacts, motion: Motion, arena: int, count: int) -> bool:
    """Sets every force to its best, the others given; says whether that changed any."""
    largest = wp.float32(0.0)
    change = wp.float32(0.0)
    for i in range(count):
        row = contacts.row[arena, i]
        force = contacts.force[arena, i]
        short = contacts.aref[arena, i] - _along(row, motion.qacc, arena) - row.give * force
        more = wp.max(short / row.stiffness, -force)
        contacts.force[arena, i] = force + more
        _push(row, motion, arena, more)
        largest = wp.max(largest, force + more)
        change = wp.max(change, wp.abs(more))
    return change > TOLERANCE * largest


@wp.func
def _finish(contacts: Contacts, motion: Motion, arena: int, count: int) -> None:
    """Works everything out once more from the forces, without the sweeps' rounding."""
    for dof in range(motion.qacc.shape[1]):
        motion.qacc[arena, dof] = motion.smooth[arena, dof]
        motion.qfrc[arena, dof] = 0.0
    for i in range(count):
        _push(contacts.row[arena, i], motion, arena, contacts.force[arena, i])
