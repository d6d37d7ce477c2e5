"""Material laws: their base class (`base`), the families, and how to make a law by name (`registry`)."""

from liverjax.laws.base import Law, Sum, Volumetric, isochoric_part, summands, volumetric_part
from liverjax.laws.by_region import ByRegion
from liverjax.laws.continued import Continued, continued
from liverjax.laws.families.arruda_boyce import ArrudaBoyce
from liverjax.laws.families.bogen import Bogen
from liverjax.laws.families.costa import Costa
from liverjax.laws.families.exponential import Exponential
from liverjax.laws.families.fung_demiray import FungDemiray
from liverjax.laws.families.logarithmic import Logarithmic
from liverjax.laws.families.mooney_rivlin import MooneyRivlin
from liverjax.laws.families.neo_hookean import NeoHookean, NeoHookeanCompressible
from liverjax.laws.families.ogden import Ogden
from liverjax.laws.families.saint_venant_kirchhoff import SaintVenantKirchhoff
from liverjax.laws.families.stable_neo_hookean import StableNeoHookean
from liverjax.laws.families.veronda_westmann import VerondaWestmann
from liverjax.laws.families.yeoh import Yeoh
from liverjax.laws.registry import LAWS, check_value, create, find, parameters, scaled, typical

__all__ = [
    "LAWS",
    "ArrudaBoyce",
    "Bogen",
    "ByRegion",
    "Continued",
    "Costa",
    "Exponential",
    "FungDemiray",
    "Law",
    "Logarithmic",
    "MooneyRivlin",
    "NeoHookean",
    "NeoHookeanCompressible",
    "Ogden",
    "SaintVenantKirchhoff",
    "StableNeoHookean",
    "Sum",
    "VerondaWestmann",
    "Volumetric",
    "Yeoh",
    "check_value",
    "continued",
    "create",
    "find",
    "isochoric_part",
    "parameters",
    "scaled",
    "summands",
    "typical",
    "volumetric_part",
]
