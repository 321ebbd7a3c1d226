"""Arenas spread over devices: what each device holds, and how all of them agree.

A program that is spread runs once on each device of a mesh (`jax.shard_map`), with the arenas of
that device. What is learned, decided or reported is of all arenas: it is summed over the mesh, so
that every device comes to the same numbers.

Random numbers come in streams. An arena belongs to one of them on every device count, so a run
with four streams draws the same on one, two or four devices.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

AXIS = "arenas"  # of the mesh


@dataclass(frozen=True)
class Shards:
    """How the arenas of a program are spread.

    Attributes:
      devices: D that share the arenas; with 1 there is no mesh.
      streams: S of random numbers, a multiple of D. Stream i serves the arenas from i A / S on.
    """

    devices: int = 1
    streams: int = 1

    @property
    def local_streams(self) -> int:
        """Streams that serve the arenas of one device."""
        return self.streams // self.devices

    def sum[T](self, tree: T) -> T:
        """Adds up what the devices hold; all get the sum."""
        return tree if self.devices == 1 else jax.lax.psum(tree, AXIS)

    def any(self, found: Array) -> Array:
        """Tells all devices whether something is true on one of them."""
        return found if self.devices == 1 else jax.lax.pmax(found.astype(jnp.int32), AXIS) > 0

    def gather(self, x: Array, axis: int) -> Array:
        """Puts the arenas of all devices together.

        Args:
          x: Those of this device along `axis`.
          axis: Of the arenas.

        Returns:
          All arenas, in their order, on every device.
        """
        return x if self.devices == 1 else jax.lax.all_gather(x, AXIS, axis=axis, tiled=True)

    def own_key(self, key: Array) -> Array:
        """Makes a random key for this device alone out of one that all have."""
        return key if self.devices == 1 else jax.random.fold_in(key, jax.lax.axis_index(AXIS))

    def local(self, x: Array) -> Array:
        """Takes the arenas of this device out of [A, ...], those of all devices."""
        if self.devices == 1:
            return x
        size = x.shape[0] // self.devices
        return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * size, size)

    def draw(self, key: Array, sample: Callable[[Array], Array], axis: int = 0) -> Array:
        """Draws random numbers for the arenas of this device, each stream with a key of its own.

        Args:
          key: Random key, the same on all devices, consumed.
          sample: Draws for the arenas of one stream, which lie along `axis`.
          axis: Of the arenas.

        Returns:
          What was drawn, with all arenas of the device along `axis`.
        """
        if self.streams == 1:
            return sample(key)
        first = 0 if self.devices == 1 else jax.lax.axis_index(AXIS) * self.local_streams
        index = first + jnp.arange(self.local_streams)
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(index)
        drawn = jax.vmap(sample, out_axes=axis)(keys)
        return drawn.reshape(*drawn.shape[:axis], -1, *drawn.shape[axis + 2 :])


ALONE = Shards()
