"""What a diagnosis says."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

# What a diagnosis may be called, and what a user can do about it.
VOCABULARY = MappingProxyType(
    {
        "pattern drifts between shutters": "let the camera warm up for 20 minutes, force a shutter every few "
        "seconds, and keep the subject in the middle of the image",
        "fixed pattern": "let the camera make a two-point correction before a black surface, and clean its window",
        "readings agree by place in the image": "record more views in which the same skin crosses the whole image",
        "reflected temperature stated wrong": "measure it with crumpled foil where the person stood, or leave it out",
        "lens scatters light": "clean the lens, and keep hot things out of the picture's surroundings",
        "lens scatters other than stated": "clean the lens, and measure it again with `thermal scatter`",
        "surface that is not skin": "take off what can be taken off; its temperature is not the skin's",
        "dead pixels": "have the camera's list of bad pixels renewed",
        "depth scale is off": "measure something of known size with the depth camera, and the spacing of the cameras",
        "time stamps jitter": "let camera or software stamp each thermal frame when it is taken, not when it is stored",
        "rows are read one after another": "move the camera more slowly, or use one that takes all rows at once",
        "thermal camera was knocked": "fix both cameras to one stiff plate, and calibrate the rig again",
        "outlines do not fit": "check the thermal clock, the rig and that nobody moved; repeat the scan more slowly",
        "recorded poses in another convention": "write T_world_depth in metres, quaternions as qx qy qz qw",
        "lines of recorded poses missing": "let the tracking write a line for every depth frame, or mark those it lost",
        "lines of recorded poses too many": "let the tracking write one line for every depth frame",
        "recorded poses do not fit the depth": "set tracking.refine to true, or tracking.source to estimate",
        "gain is off": "set temperature.crosscal.gain to true, and have the camera calibrated",
        "references contradict each other": "let references and camera warm up, and show them in more frames",
    }
)


@dataclass(frozen=True)
class Diagnosis:
    """One fault. size_K : its effect on readings, K, None where none is known. size : the fault's own, in `unit`.
    advice : what a user can do, by default the vocabulary's."""

    what: str
    evidence: str
    size_K: float | None
    where: str
    done: str
    advice: str = ""
    size: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.advice:
            object.__setattr__(self, "advice", VOCABULARY[self.what])

    def line(self) -> str:
        """For the terminal."""
        sizes = [] if self.size is None else [f"{self.size:.3g} {self.unit}"]
        sizes += [] if self.size_K is None else [f"{self.size_K:.2f} K"]
        size = f" ({', '.join(sizes)})" if sizes else ""
        return f"{self.what}{size}, {self.where}: {self.done}; {self.advice}"
