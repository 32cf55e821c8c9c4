"""The nouns that result files store, each under a name and version of its own: no file says which code to call."""

from __future__ import annotations

from functools import cache
from types import MappingProxyType

from ..errors import ScanError

# Names under which version 0.1.0 of the program stored what `result.npz` holds.
OLD_NAMES = MappingProxyType(
    {
        "thermofusion.crosscal:CrosscalResult": "calibration/1",
        "thermofusion.imagefield:ImageField": "image-field/1",
        "thermofusion.thermometry:Temperature": "temperature/1",
        "thermofusion.types:SurfaceMesh": "surface-mesh/1",
        "thermofusion.types:ThermalMesh": "thermal-mesh/1",
    }
)


def _shape() -> dict[str, type]:
    """Nouns of the surface and of its motion."""
    from ..motion.body import BodyMotion, PartMotion
    from ..motion.field import MotionField
    from ..motion.graph import Binding
    from ..surface.clean import RemovedPart
    from ..surface.surface import SurfaceResult

    return {
        "binding/1": Binding,
        "body-motion/1": BodyMotion,
        "motion-field/1": MotionField,
        "part-motion/1": PartMotion,
        "removed-part/1": RemovedPart,
        "surface/2": SurfaceResult,
        "surface/1": SurfaceResult,  # without `motion`
    }


def _of_types() -> dict[str, type]:
    """Nouns that several rooms share."""
    from ..types import (
        BudgetInput,
        Camera,
        LensScatter,
        Observations,
        SharedErrors,
        SignalCurve,
        SurfaceMesh,
        ThermalCamera,
        ThermalMesh,
        ThermalViews,
        Trajectory,
    )

    return {
        "budget-input/1": BudgetInput,
        "camera/1": Camera,
        "lens-scatter/2": LensScatter,
        "lens-scatter/1": LensScatter,  # without `stated`
        "observations/1": Observations,
        "shared-errors/1": SharedErrors,
        "signal-curve/1": SignalCurve,
        "surface-mesh/1": SurfaceMesh,
        "thermal-camera/3": ThermalCamera,
        "thermal-camera/2": ThermalCamera,  # without `scatter`
        "thermal-camera/1": ThermalCamera,  # without `mount`
        "thermal-mesh/3": ThermalMesh,
        "thermal-mesh/2": ThermalMesh,  # without `moved_mm`
        "thermal-mesh/1": ThermalMesh,  # without `residual`
        "thermal-views/1": ThermalViews,
        "trajectory/1": Trajectory,
    }


@cache
def stored() -> MappingProxyType[str, type]:
    """Name and version -> class. A class whose fields change gets a new version; the old one stays, with its reader."""
    from ..mapping.background import Background
    from ..mapping.corrections import MotionResult
    from ..mapping.observe import Mapped
    from ..mapping.references import BlackbodyReading
    from ..rig.align import RigResult
    from ..rig.free.place import FreeViews
    from ..rig.knock import Knocks
    from ..rig.rows import ReadOut
    from ..temperature.crosscal import Calibration
    from ..temperature.room.map import RoomMap
    from ..temperature.sensor.field import ImageField
    from ..temperature.sensor.pattern import Pattern
    from ..temperature.solve import Temperature
    from ..tracking.faults import PoseFault
    from ..tracking.track import LostRange, TrackingResult

    return MappingProxyType(
        {
            **_shape(),
            **_of_types(),
            "background/2": Background,
            "background/1": Background,  # without `halo`
            "blackbody-reading/1": BlackbodyReading,
            "calibration/1": Calibration,
            "free-views/1": FreeViews,
            "image-field/1": ImageField,
            "knocks/1": Knocks,
            "lost-range/1": LostRange,
            "mapped/5": Mapped,
            "mapped/4": Mapped,  # without `readout`
            "mapped/3": Mapped,  # without `scatter`
            "mapped/2": Mapped,  # without `unsettled`
            "mapped/1": Mapped,  # without `background`
            "motion/1": MotionResult,
            "pose-fault/1": PoseFault,
            "read-out/1": ReadOut,
            "rig/4": RigResult,
            "rig/3": RigResult,  # without `knocks`
            "rig/2": RigResult,  # without `readout`
            "rig/1": RigResult,  # without `free`, `frame_dt_s`, `depth_scale`
            "room-map/1": RoomMap,
            "sensor-pattern/1": Pattern,
            "temperature/5": Temperature,
            "temperature/4": Temperature,  # without `materials`
            "temperature/3": Temperature,  # without `inputs`
            "temperature/2": Temperature,  # without `room`
            "temperature/1": Temperature,  # without `shared`
            "tracking/2": TrackingResult,
            "tracking/1": TrackingResult,  # without `faults`
        }
    )


def name_of(value: object) -> str:
    """The name under which an object is stored. Raises TypeError for what is no stored noun."""
    for name, cls in stored().items():
        if type(value) is cls:
            return name
    raise TypeError(f"{type(value).__name__} is no noun that results store")


def class_of(name: object) -> type:
    """The class of a stored name, today's or an old one. Raises ScanError for an unknown or a newer one."""
    cls = stored().get(OLD_NAMES.get(str(name), str(name)))
    if cls is None:
        shown = ascii(str(name)[:60])
        raise ScanError(
            f"it holds {shown}, which this version of thermofusion does not know",
            hint="run the scan again, or read the result with the version that wrote it",
        )
    return cls
