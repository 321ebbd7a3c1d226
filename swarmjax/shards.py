"""Spreads arenas over devices, and combines the numbers of all devices.

The program runs once on each device of a mesh (`jax.shard_map`), with the arenas of that device.
Learning, decisions and reports use all arenas: the numbers of the devices are summed over the mesh,
so that all devices get the same result.

Random numbers come in streams. Each arena belongs to one stream, whatever the number of devices. So
a run with four streams draws the same random numbers on one, two or four devices.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

AXIS = "arenas"  # name of the mesh axis


@dataclass(frozen=True)
class Shards:
    """How the arenas of a program are spread over devices and random streams.

    Attributes:
      devices: D, the number of devices that share the arenas. With 1 there is no mesh.
      streams: S, the number of random streams, a multiple of D. Stream i serves A / S of
        the A arenas; its first arena is arena i * A / S.
    """

    devices: int = 1
    streams: int = 1

    @property
    def local_streams(self) -> int:
        """Number of streams that serve the arenas of one device."""
        return self.streams // self.devices

    def sum[T](self, tree: T) -> T:
        """Adds up the values of all devices, and gives each device the sum."""
        return tree if self.devices == 1 else jax.lax.psum(tree, AXIS)

    def any(self, found: Array) -> Array:
        """Returns, on all devices, whether something is true on at least one of them."""
        return found if self.devices == 1 else jax.lax.pmax(found.astype(jnp.int32), AXIS) > 0

    def gather(self, x: Array, axis: int) -> Array:
        """Joins the arenas of all devices.

        Args:
          x: the values of this device's arenas, along `axis`.
          axis: the axis of arenas.

        Returns:
          The values of all arenas, in order, on every device.
        """
        return x if self.devices == 1 else jax.lax.all_gather(x, AXIS, axis=axis, tiled=True)

    def own_key(self, key: Array) -> Array:
        """Derives a random key for this device from a key that all devices share."""
        return key if self.devices == 1 else jax.random.fold_in(key, jax.lax.axis_index(AXIS))

    def local(self, x: Array, axis: int = 0) -> Array:
        """Selects this device's arenas from the values of all arenas along `axis`."""
        if self.devices == 1:
            return x
        size = x.shape[axis] // self.devices
        return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * size, size, axis)

    def draw(self, key: Array, sample: Callable[[Array], Array], axis: int = 0) -> Array:
        """Draws random numbers for the arenas of this device, with a separate key per stream.

        Args:
          key: random key, the same on all devices; consumed.
          sample: draws for the arenas of one stream, along `axis`.
          axis: the axis of arenas.

        Returns:
          The random numbers, with all arenas of the device along `axis`.
        """
        if self.streams == 1:
            return sample(key)
        first = 0 if self.devices == 1 else jax.lax.axis_index(AXIS) * self.local_streams
        index = first + jnp.arange(self.local_streams)
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(index)
        drawn = jax.vmap(sample, out_axes=axis)(keys)
        return drawn.reshape(*drawn.shape[:axis], -1, *drawn.shape[axis + 2 :])


ALONE = Shards()
