"""The settings of an export."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.config.section import MAX_COUNT


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Section):
    """Settings: which policy to export, in which format, and where to."""

    command: ClassVar[str] = "export"

    run: str | None = setting(None, "run directory; give either run or policy")
    policy: str | None = setting(None, "path of a policy.npz; give either run or policy")
    format: Literal["npz", "onnx", "c", "webots"] = setting(
        "npz", "form of the export; npz and onnx are one file, c and webots a folder"
    )
    step: int | None = setting(
        None, "update at which the checkpoint was saved; null: the newest valid one", 0, MAX_COUNT
    )
    seed: int | None = setting(None, "seed of the run's policy; null: all seeds", 0, MAX_COUNT)
    out: str | None = setting(
        None, "file or folder to write; null: named by format and step, in run or beside policy"
    )
    extensions: str | None = setting(
        None, "Python file with the extension that the policy needs; it is executed"
    )

    def _check(self) -> None:
        if (self.run is None) == (self.policy is None):
            raise ConfigError(
                f"run is {show(self.run)} and policy is {show(self.policy)}: give exactly one of "
                "the two, as in run=runs/a or policy=policy.npz."
            )
        for key in ("step", "seed"):
            if self.run is None and getattr(self, key) is not None:
                raise ConfigError(
                    f"{key} is {getattr(self, key)}, but works only with run: leave {key} out."
                )
        if self.out is None and self.run is None and self.format == "npz":
            raise ConfigError("out is null, but policy is already an npz file: give out=FILE.")
