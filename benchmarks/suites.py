"""Defines the suites of `benchmarks.run`: benchmarks and their sizes, the most important first.

Each entry of a suite answers one question, by running one file of benchmarks/ in its own process.
"""

from dataclasses import dataclass, field, replace

CPU = {"JAX_PLATFORMS": "cpu"}
# Peers multiply matrices in full precision, so that tensor cores make no difference to them.
HIGHEST = {"JAX_DEFAULT_MATMUL_PRECISION": "highest"}
# Without preallocation, the drop in the GPU's free memory shows what XLA and Warp really allocate.
AS_NEEDED = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
ARENAS = ("65536", "16384", "262144", "4096", "1024", "256")
SEEDS = ("0", "1", "2", "3", "4")


@dataclass(frozen=True, kw_only=True)
class SuiteEntry:
    """One benchmark with its settings.

    Attributes:
      name: name of the entry, which its lines also have.
      module: module in benchmarks/.
      words: `key=value` arguments.
      over: key whose several values are measured one by one.
      values: the values of `over`; each line has one of them.
      each: number of values per process; None: all values in one process.
      seconds: time limit, s; a process that prints nothing for this long is ended.
      environment: environment variables of the process.
    """

    name: str
    module: str
    words: tuple[str, ...] = ()
    over: str | None = None
    values: tuple[str, ...] = ()
    each: int | None = None
    seconds: float = 300.0
    environment: dict[str, str] = field(default_factory=dict)


def _speed(name: str, *words: str, values: tuple[str, ...] = ARENAS) -> SuiteEntry:
    """Makes an entry for physics, environment and training at several numbers of arenas."""
    return SuiteEntry(
        name=name,
        module="steps_per_second",
        words=("budget=1e10", *words),
        over="arenas",
        values=values,
        seconds=480.0,  # the first line comes after all values are compiled
    )


def _robots(name: str, *words: str) -> SuiteEntry:
    """Makes an entry for physics, environment and training at several numbers of robots."""
    values = ("5", "1", "50", "10", "20", "2", "3")
    return SuiteEntry(
        name=name, module="robots_speed", words=words, over="robots", values=values, seconds=480.0
    )


def _memory(name: str, *words: str) -> SuiteEntry:
    """Makes a memory entry; each size has its own process, since a peak covers a whole process."""
    return SuiteEntry(
        name=name,
        module="memory",
        words=words,
        over="arenas",
        values=("16384", "65536"),
        each=1,
        environment=AS_NEEDED,
    )


def _peer(name: str, values: tuple[str, ...], *words: str) -> SuiteEntry:
    """Makes an entry for the speed of a peer's environment."""
    return SuiteEntry(
        name=name, module=name, words=words, over="arenas", values=values, environment=HIGHEST
    )


_WARP = "sim.impl=warp"
_SLOW = ("16384", "4096", "1024", "256")
_LARGE = ("65536", "16384", "262144", "4096")
_RACED = ("stage=s6", _WARP, "arenas=8192")

HEADLINE = (
    _speed("planar-warp", _WARP),
    _speed("wheeled-warp", _WARP, "robot=wheeled"),
)
PEERS = (
    _peer("peer_vmas", ("262144", "65536", "16384", "4096")),
    _peer("peer_camar", _LARGE),
    _peer("peer_jaxnav", ("65536", "16384", "4096"), "step=pool"),
    replace(_peer("peer_jaxnav", ("16384",), "step=default"), name="peer_jaxnav-default"),
)
TRAINERS = (
    SuiteEntry(
        name="race-swarmjax",
        module="race",
        words=("trainer=swarmjax", "points=100", *_RACED, "budget=80e6"),
        over="seed",
        values=SEEDS,
    ),
    SuiteEntry(
        name="race-brax",
        module="race",
        words=("trainer=brax", "points=100", *_RACED, "budget=80e6"),
        over="seed",
        values=SEEDS,
        seconds=400.0,
    ),
    SuiteEntry(
        name="race-brax-playground",
        module="race",
        words=("trainer=brax", "settings=playground", "points=10", *_RACED, "budget=16e6"),
        over="seed",
        values=SEEDS,
        seconds=400.0,
    ),
    SuiteEntry(
        name="peer_jaxmarl_ippo",
        module="peer_jaxmarl_ippo",
        over="arenas",
        values=("16384", "4096"),
        environment=HIGHEST,
    ),
    SuiteEntry(name="peer_benchmarl", module="peer_benchmarl", over="arenas", values=("4096",)),
)
START = (
    SuiteEntry(name="start_up", module="start_up", words=("stage=s6", _WARP, "arenas=16384")),
    SuiteEntry(
        name="start_up-wheeled",
        module="start_up",
        words=("stage=s6", _WARP, "robot=wheeled", "arenas=16384"),
    ),
)
SUCCESS = (
    SuiteEntry(
        name="success-wheeled",
        module="command_to_success",
        words=("stage=s6", _WARP, "robot=wheeled", "arenas=16384", "budget=80e6"),
        over="seed",
        values=SEEDS,
        seconds=240.0,
    ),
    SuiteEntry(
        name="success-planar",
        module="command_to_success",
        words=("stage=s6", _WARP, "arenas=16384", "budget=150e6"),
        over="seed",
        values=SEEDS,
        seconds=240.0,
    ),
)
SWEEP = (
    *HEADLINE,
    _speed("planar-jax", "sim.impl=jax"),
    _speed("wheeled-jax", "sim.impl=jax", "robot=wheeled", values=_SLOW),
    _robots("robots-planar", _WARP),
    _robots("robots-wheeled", _WARP, "robot=wheeled"),
    _memory("memory-planar", _WARP, "stage=s6"),
    _memory("memory-wheeled", _WARP, "stage=s6", "robot=wheeled"),
    replace(
        _speed("wheeled-jax-large", "sim.impl=jax", "robot=wheeled", values=("65536", "262144")),
        seconds=1200.0,
    ),
)
ON_CPU = tuple(
    replace(entry, environment=CPU | entry.environment)
    for entry in (
        _speed("cpu-planar", "sim.impl=jax", values=("128", "64", "256")),
        _speed("cpu-wheeled", "sim.impl=jax", "robot=wheeled", values=("64",)),
        SuiteEntry(name="cpu_paper_way", module="cpu_paper_way", words=("seconds=30",)),
        SuiteEntry(name="cpu_sb3", module="cpu_sb3", words=("seconds=30",)),
        SuiteEntry(
            name="cpu-benchmarl",
            module="peer_benchmarl",
            words=("device=cpu",),
            over="arenas",
            values=("64",),
        ),
        SuiteEntry(
            name="cpu-success",
            module="command_to_success",
            over="seed",
            values=SEEDS,
            seconds=900.0,
        ),
        SuiteEntry(name="cpu-start_up", module="start_up"),
    )
)
QUICK = tuple(
    replace(entry, environment=CPU | entry.environment)
    for entry in (
        _speed("quick-planar", "sim.impl=jax", values=("64",)),
        SuiteEntry(
            name="quick-cpu_paper_way", module="cpu_paper_way", words=("seconds=5", "rollout=1000")
        ),
        SuiteEntry(name="quick-cpu_sb3", module="cpu_sb3", words=("seconds=5",)),
        *(
            replace(_peer(name, ("64",), "steps=16", *words), name=f"quick-{name}", module=name)
            for name, words in {
                "peer_vmas": ("device=cpu",),
                "peer_camar": (),
                "peer_jaxnav": ("pool=64",),
            }.items()
        ),
    )
)

SUITES: dict[str, tuple[SuiteEntry, ...]] = {
    "quick": QUICK,
    "headline": HEADLINE,
    "peers": (*HEADLINE, *PEERS),
    "trainers": TRAINERS,
    "success": (*START, *SUCCESS),
    "sweep": SWEEP,
    "cpu": ON_CPU,
    "gpu": (*HEADLINE, *PEERS, *TRAINERS, *START, *SUCCESS, *SWEEP[2:]),
}
