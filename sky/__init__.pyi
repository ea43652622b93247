from .catalogue import read_galaxies as read_galaxies
from .catalogue import write_galaxies as write_galaxies
from .galaxies import Galaxies as Galaxies
from .mosaic import GalaxyStamps as GalaxyStamps
from .sky_shapes import SkyShapes as SkyShapes
from .visit_list.read_list import read_visit_list as read_visit_list
from .visit_list.visit_list import ListedVisit as ListedVisit
from .visit_list.visit_list import VisitList as VisitList
