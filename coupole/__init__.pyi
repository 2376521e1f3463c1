from coupole import errors as errors
from coupole import testing as testing
from coupole.heritage.analysis.identification import PigmentFinding as PigmentFinding
from coupole.heritage.comparison.state_comparison import Comparison as Comparison
from coupole.preflight.preflight import Report as Report
from coupole.reflectance.new_light import light_kinds as lights
from coupole.reflectance.new_light.pictured_surface import FreeCamera as FreeCamera
from coupole.scan.registration.registering import Registration as Registration
from coupole.scripting.acquisition import Acquisition as Acquisition
from coupole.scripting.acquisition import acquire as acquire
from coupole.scripting.analyses import CalibrationRecord as CalibrationRecord
from coupole.scripting.analyses import calibrate_camera as calibrate_camera
from coupole.scripting.analyses import compare as compare
from coupole.scripting.analyses import fit_reflectance as fit_reflectance
from coupole.scripting.analyses import identify as identify
from coupole.scripting.analyses import register as register
from coupole.scripting.cell_devices import open_cell as open_cell
from coupole.scripting.colour_profiles import calibrate_colour as calibrate_colour
from coupole.scripting.opened_result import Materials as Materials
from coupole.scripting.opened_result import PicturesResult as PicturesResult
from coupole.scripting.opened_result import Result as Result
from coupole.scripting.opened_result import open_result as open_result
from coupole.scripting.opened_run import Run as Run
from coupole.scripting.opened_run import RunView as RunView
from coupole.scripting.opened_run import open_run as open_run
from coupole.scripting.plans import Plan as Plan
from coupole.scripting.plans import Rig as Rig
from coupole.scripting.proven_frame import Frame as Frame
from coupole.storage import journal_events as events

__all__ = [
    "Acquisition", "CalibrationRecord", "Comparison", "Frame", "FreeCamera", "Materials", "PicturesResult",
    "PigmentFinding", "Plan", "Registration", "Report", "Result", "Rig", "Run", "RunView", "acquire",
    "calibrate_camera", "calibrate_colour", "compare", "errors", "events", "fit_reflectance", "identify", "lights",
    "open_cell", "open_result", "open_run", "register", "testing",
]  # fmt: skip

__version__: str
_NAMES: dict[str, str]
_MODULES: dict[str, str]
