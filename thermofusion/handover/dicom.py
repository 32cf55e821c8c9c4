"""A result as a DICOM study: pictures and maps in °C of the standard views, the coloured surface, regions, the report.

Needs the extra `thermofusion[dicom]` (pydicom, highdicom). Identifiers follow from the result, so that the same result
gives the same study. Everything lies in one frame of reference: the body's, x to its left, y to its back, z to its
head (DICOM's patient axes), in millimetres from its middle.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecipeError, ResourceError
from ..export import write_obj
from ..export.axes import axes_of
from ..export.palettes import color_range
from ..files.whole import write_whole
from ..regions import Measured, Measurer, Reading
from ..report.casts import Cast, cast_views
from ..report.html import TITLES, Reported, write_report
from ..report.lettering import Scale
from ..report.pictures import paint
from ..types import Float32
from ..version import __version__

HEIGHT_PX = 800  # of a view: 2 mm of a standing person
NOBODY = "ANONYMOUS"
MAKER, MODEL = "thermofusion", "thermofusion"
CHROMIUM_SECONDS = 60
# Of each view: the picture's right and its down, in patient axes.
ORIENTATION = {
    "front": (1, 0, 0, 0, 0, -1),
    "back": (-1, 0, 0, 0, 0, -1),
    "left": (0, 1, 0, 0, 0, -1),
    "right": (0, -1, 0, 0, 0, -1),
}
ACROSS = {"front": "L", "back": "R", "left": "P", "right": "A"}  # what the picture's right side is toward
# Words of a region's name -> pydicom's name of the SNOMED code "skin of"; the first that is found counts.
SITES = {
    "forehead": "SkinOfForehead", "eye corner": "SkinOfMedialCanthus", "cheek": "SkinOfCheek", "nose": "SkinOfNose",
    "face": "SkinOfFace", "neck": "SkinOfNeck", "breast": "SkinOfChest", "chest": "SkinOfChest",
    "abdomen": "SkinOfAbdomen", "belly": "SkinOfAbdomen", "lower back": "SkinOfLowerBack", "back": "SkinOfBack",
    "buttock": "SkinOfButtock", "axilla": "SkinOfAxilla", "forearm": "SkinOfAnteriorSurfaceOfForearm",
    "elbow": "SkinOfPosteriorSurfaceOfElbow", "hand": "SkinOfHand", "palm": "SkinOfPalmOfHand",
    "finger": "SkinOfDigitOfHand", "arm": "SkinOfUpperExtremity", "thigh": "SkinOfAnteriorSurfaceOfThigh",
    "knee": "SkinOfAnteriorSurfaceOfKnee", "shin": "SkinOfAnteriorSurfaceOfLowerLeg", "heel": "SkinOfHeel",
    "calf": "SkinOfPosteriorSurfaceOfLowerLeg", "foot": "SkinOfFoot", "toe": "SkinOfToe", "leg": "SkinOfLowerExtremity",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Study:
    """What all instances share."""

    reported: Reported
    seed: str
    date: str
    patient: str

    def uid(self, *names: str) -> str:
        from pydicom.uid import generate_uid

        return str(generate_uid(entropy_srcs=[self.seed, *names]))

    @property
    def deidentified(self) -> bool:
        return bool(self.reported.report.get("deidentified", False))

    @property
    def common(self) -> dict[str, Any]:
        return {
            "study_instance_uid": self.uid("study"),
            "manufacturer": MAKER,
            "patient_id": self.patient,
            "patient_name": f"{self.patient}^",
            "study_date": self.date,
            "study_time": "",
        }


def write_study(folder: Path, reported: Reported) -> list[Path]:
    """Write the study's instances into a folder, made if need be; their paths.

    Raises RecipeError without the extra, ResourceError.
    """
    try:
        import highdicom  # noqa: F401
    except ImportError:
        raise RecipeError("DICOM needs pydicom and highdicom", hint="pip install 'thermofusion[dicom]'") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ResourceError(f"the folder cannot be made ({e.strerror})", place=folder) from None
    mesh = reported.temperature.mesh
    study = _study(reported)
    casts = cast_views(mesh.surface, axes_of(mesh.metadata), HEIGHT_PX)
    pictures = [_picture(study, cast, k) for k, cast in enumerate(casts, 1)]
    instances = {f"picture-{cast.name}": ds for cast, ds in zip(casts, pictures, strict=True)}
    for k, (cast, picture) in enumerate(zip(casts, pictures, strict=True), 1):
        instances[f"temperature-{cast.name}"] = _map(study, cast, picture, 2, k)
        instances[f"sigma-{cast.name}"] = _map(study, cast, picture, 3, k)
    instances["surface"] = _surface(study)
    if reported.regions:
        instances["regions"] = _regions(study, pictures)
    pages = _report_pdf(reported)
    if pages is not None:
        instances["report"] = _encapsulated(study, "1.2.840.10008.5.1.4.1.1.104.1", "application/pdf", pages, 6, "DOC")
    return [_save(folder / f"{name}.dcm", ds) for name, ds in instances.items()]


def _study(reported: Reported) -> _Study:
    report = reported.report
    given = {row["key"]: row["value"] for row in report.get("metadata", []) if row.get("value")}
    day = re.sub(r"\D", "", str(report.get("scan", {}).get("recorded_at") or ""))[:8]
    patient = re.sub(r"[\\^=\x00-\x1f]", " ", str(given.get("subject.pseudonym") or NOBODY))[:64]
    T = reported.temperature.mesh.temperature_degC
    seed = f"{np.nansum(T.astype(np.float64)):.9e} {len(T)} {report.get('scan', {}).get('name')} {patient}"
    return _Study(reported, seed, day if len(day) == 8 else "", patient)


def _save(path: Path, ds: Any) -> Path:
    from io import BytesIO

    from pydicom import dcmwrite

    stream = BytesIO()
    dcmwrite(stream, ds, enforce_file_format=True)
    return write_whole(path, [stream.getvalue()])


def _equip(ds: Any, modality: str) -> Any:
    """Modality, and the device that saw it: a combined structured light and thermal imager."""
    from pydicom.dataset import Dataset
    from pydicom.sr.codedict import codes

    def code(concept: Any) -> Any:
        item = Dataset()
        item.CodeValue, item.CodingSchemeDesignator = concept.value, concept.scheme_designator
        item.CodeMeaning = concept.meaning
        return item

    device = Dataset()
    device.PurposeOfReferenceCodeSequence = [code(codes.DCM.AcquisitionEquipment)]
    device.Manufacturer, device.DeviceTypeCodeSequence = MAKER, [code(codes.DCM.CombinedStructuredLightThermalImager)]
    ds.Modality, ds.SoftwareVersions = modality, __version__
    if modality == "TG":
        ds.Laterality = ""  # the whole body
    ds.ManufacturerModelName, ds.DeviceSerialNumber = MODEL, __version__
    ds.ContributingEquipmentSequence = [*getattr(ds, "ContributingEquipmentSequence", []), device]
    return ds


def _picture(study: _Study, cast: Cast, number: int) -> Any:
    """The view as a coloured picture, Secondary Capture."""
    from highdicom.sc import SCImage

    mesh, output = study.reported.temperature.mesh, study.reported.recipe.output
    lo, hi = color_range(mesh.temperature_degC, output.range_degC)
    rgb = paint(cast, mesh.temperature_degC, Scale(output.palette, lo, hi, "°C", TITLES[mesh.mode]))
    spacing = 1e3 / cast.px_per_m
    ds = SCImage(
        pixel_array=rgb,
        photometric_interpretation="RGB",
        bits_allocated=8,
        coordinate_system="PATIENT",
        series_instance_uid=study.uid("pictures"),
        series_number=1,
        sop_instance_uid=study.uid("picture", cast.name),
        instance_number=number,
        pixel_spacing=(spacing, spacing),
        patient_orientation=(ACROSS[cast.name], "F"),
        **study.common,
    )
    ds.SeriesDescription = f"{TITLES[mesh.mode]} {lo:g} to {hi:g} degC, {output.palette}"
    ds.ImageComments = f"{cast.name} view; research use, not a diagnosis"
    return _equip(ds, "TG")


def pixels(cast: Cast, values: np.ndarray) -> Float32:
    """(H, W) mean over each pixel's skin of values (V,) in their unit; NaN where there is none."""
    value = cast.interpolate(values)
    skin = (cast.facing >= 0) & ~np.isnan(value)
    share = cast.per_pixel(skin)
    mean = cast.per_pixel(np.where(skin, value, 0)) / np.maximum(share, 1e-6)
    return np.where(share > 0, mean, np.float32(np.nan)).astype(np.float32)


def _map(study: _Study, cast: Cast, picture: Any, series: int, number: int) -> Any:
    """Temperature (series 2) or its sigma (series 3) of a view: float32, every bit."""
    from highdicom import VOILUTTransformation
    from highdicom.pm import ParametricMap, RealWorldValueMapping
    from pydicom.sr.codedict import codes
    from pydicom.sr.coding import Code

    mesh, sigma = study.reported.temperature.mesh, series == 3
    values = pixels(cast, mesh.uncertainty_K if sigma else mesh.temperature_degC)
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    unit = Code("K", "UCUM", "Kelvin") if sigma else codes.UCUM.DegreesCelsius
    label, text = ("SIGMA", "one sigma of the temperature") if sigma else ("TEMPERATURE", TITLES[mesh.mode])
    mapping = RealWorldValueMapping(
        lut_label=label, lut_explanation=text[:64], unit=unit, value_range=(low, high), slope=1.0, intercept=0.0
    )
    ds = ParametricMap(
        source_images=[_placed(study, cast, picture)],
        pixel_array=values,
        series_instance_uid=study.uid("maps", label),
        series_number=series,
        sop_instance_uid=study.uid("map", label, cast.name),
        instance_number=number,
        manufacturer=MAKER,
        manufacturer_model_name=MODEL,
        software_versions=__version__,
        device_serial_number=__version__,
        contains_recognizable_visual_features=not study.deidentified,
        real_world_value_mappings=[mapping],
        voi_lut_transformations=[VOILUTTransformation((low + high) / 2, max(high - low, 0.1), None, "LINEAR_EXACT")],
        content_label=label,
        content_description=f"{text}, {cast.name} view"[:64],
    )
    ds.SeriesDescription = f"{text}, {'K' if sigma else 'degC'}"
    return _equip(ds, "TG")


def _placed(study: _Study, cast: Cast, picture: Any) -> Any:
    """The picture with its place in the body's frame, which Secondary Capture itself does not hold: maps lie there."""
    from copy import deepcopy

    spacing, (h, w), orientation = 1e3 / cast.px_per_m, cast.shape, ORIENTATION[cast.name]
    right, down = np.array(orientation[:3], float), np.array(orientation[3:], float)
    placed = deepcopy(picture)
    placed.FrameOfReferenceUID, placed.PositionReferenceIndicator = study.uid("frame"), ""
    placed.PixelSpacing, placed.SliceThickness = [spacing, spacing], 1.0
    placed.ImageOrientationPatient = list(orientation)
    placed.ImagePositionPatient = (-spacing * ((w - 1) / 2 * right + (h - 1) / 2 * down)).tolist()
    return placed


def _surface(study: _Study) -> Any:
    """The coloured surface: Encapsulated OBJ."""
    output = study.reported.recipe.output
    with tempfile.TemporaryDirectory() as folder:
        path = write_obj(Path(folder) / "mesh.obj", study.reported.temperature.mesh, output.palette, output.range_degC)
        data = path.read_bytes()
    return _encapsulated(study, "1.2.840.10008.5.1.4.1.1.104.4", "model/obj", data, 4, "M3D")


def _encapsulated(study: _Study, sop_class: str, mime: str, data: bytes, series: int, modality: str) -> Any:
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.sr.codedict import codes
    from pydicom.uid import UID, ExplicitVRLittleEndian

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = UID(sop_class), UID(study.uid(mime))
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    ds.SpecificCharacterSet = "ISO_IR 192"
    ds.SOPClassUID, ds.SOPInstanceUID = sop_class, meta.MediaStorageSOPInstanceUID
    ds.StudyInstanceUID, ds.SeriesInstanceUID = study.uid("study"), study.uid("series", mime)
    ds.PatientID, ds.PatientName = study.patient, f"{study.patient}^"
    ds.PatientBirthDate = ds.PatientSex = ds.StudyTime = ds.AccessionNumber = ds.ReferringPhysicianName = ""
    ds.StudyDate, ds.StudyID, ds.SeriesNumber, ds.InstanceNumber = study.date, "", series, 1
    ds.ContentDate, ds.ContentTime, ds.AcquisitionDateTime = study.date, "", study.date
    ds.BurnedInAnnotation = ds.RecognizableVisualFeatures = "NO" if study.deidentified else "YES"
    ds.ConversionType = "WSD"
    ds.DocumentTitle, ds.ConceptNameCodeSequence = "thermofusion", []
    ds.MIMETypeOfEncapsulatedDocument, ds.Manufacturer = mime, MAKER
    ds.EncapsulatedDocumentLength = len(data)
    ds.EncapsulatedDocument = data + b"\0" * (len(data) % 2)
    if mime == "model/obj":
        from highdicom.sr import CodedConcept

        ds.FrameOfReferenceUID, ds.PositionReferenceIndicator = study.uid("frame"), ""
        metre = CodedConcept("m", "UCUM", "meter")
        ds.MeasurementUnitsCodeSequence = [metre]
        ds.ModelModification, ds.ModelMirroring = "NO", "NO"
        ds.ModelUsageCodeSequence = [CodedConcept.from_code(codes.DCM.PlanningIntent)]
        ds.ContentDescription = "skin, coloured by temperature"
    return _equip(ds, modality)


def _regions(study: _Study, pictures: list[Any]) -> Any:
    """What the regions read: SR after TID 1500, one group a region with its skin's SNOMED site."""
    from highdicom import sr
    from pydicom.sr.codedict import codes

    reported = study.reported
    measurer = Measurer(reported.temperature.mesh, reported.temperature.shared)
    groups = [
        _group(study, sr, r, k)
        for k, r in enumerate(Measured.of(measurer, reported.regions).readings, 1)
        if np.isfinite(r.value_degC)
    ]
    device = sr.DeviceObserverIdentifyingAttributes(
        uid=study.uid("device"), name=MAKER, manufacturer_name=MAKER, model_name=f"{MODEL} {__version__}"
    )
    observer = sr.ObserverContext(sr.CodedConcept.from_code(codes.DCM.Device), device)
    content = sr.MeasurementReport(
        observation_context=sr.ObservationContext(observer_device_context=observer),
        procedure_reported=sr.CodedConcept("THERMO3D", "99TMF", "Three-dimensional thermography"),
        imaging_measurements=groups,
        title=codes.DCM.ImagingMeasurementReport,
        referenced_images=pictures,
    )
    ds = sr.Comprehensive3DSR(
        evidence=pictures,
        content=content[0],
        series_instance_uid=study.uid("regions"),
        series_number=5,
        sop_instance_uid=study.uid("region report"),
        instance_number=1,
        manufacturer=MAKER,
    )
    return _equip(ds, "SR")


def _group(study: _Study, sr: Any, reading: Reading, number: int) -> Any:
    from pydicom.sr.codedict import codes

    name = reading.name or f"region {number}"
    temperature = sr.CodedConcept("39106-0", "LN", "Temperature of Skin")
    celsius, kelvin = codes.UCUM.DegreesCelsius, sr.CodedConcept("K", "UCUM", "Kelvin")
    mean = sr.Measurement(name=temperature, value=reading.value_degC, unit=celsius, derivation=codes.SCT.Mean)
    measured = [mean]
    sigma = sr.CodedConcept("SIGMA", "99TMF", "One sigma of the temperature about the body's level")
    if np.isfinite(reading.sigma_K):
        measured.append(sr.Measurement(name=sigma, value=reading.sigma_K, unit=kelvin))
    if np.isfinite(reading.sd_K):
        extremes = ((reading.min_degC, codes.SCT.Minimum), (reading.max_degC, codes.SCT.Maximum))
        measured += [sr.Measurement(name=temperature, value=float(v), unit=celsius, derivation=d) for v, d in extremes]
    if np.isfinite(reading.area_cm2):
        area = sr.CodedConcept("42798000", "SCT", "Area")
        measured.append(sr.Measurement(name=area, value=reading.area_cm2, unit=sr.CodedConcept("cm2", "UCUM", "cm2")))
    return sr.MeasurementsAndQualitativeEvaluations(
        tracking_identifier=sr.TrackingIdentifier(uid=study.uid("region", str(number)), identifier=name),
        finding_sites=[_site(sr, name)],
        measurements=measured,
    )


def _site(sr: Any, name: str) -> Any:
    """The skin of which a region's name speaks; the skin as such where it names none."""
    from pydicom.sr.codedict import codes

    low = name.lower()
    key = next((SITES[word] for word in SITES if word in low), "Skin")
    side = next((getattr(codes.SCT, s) for s in ("Left", "Right") if s.lower() in low.split()), None)
    return sr.FindingSite(getattr(codes.SCT, key), laterality=side)


def _report_pdf(reported: Reported) -> bytes | None:
    """The report's pages, where Chromium is there to print them."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        page, pages = write_report(Path(folder) / "report.html", reported), Path(folder) / "report.pdf"
        command = [chromium, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                   f"--user-data-dir={folder}/profile", "--no-pdf-header-footer", f"--print-to-pdf={pages}",
                   "--virtual-time-budget=20000", page.as_uri()]  # fmt: skip
        try:
            subprocess.run(command, capture_output=True, timeout=CHROMIUM_SECONDS, check=True)
            return pages.read_bytes()
        except (OSError, subprocess.SubprocessError):
            return None
