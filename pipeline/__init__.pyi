from .config import load_configuration as load_configuration
from .run import RunResult as RunResult
from .sensor.brighter_fatter import brighter_fatter as brighter_fatter
from .sensor.displacement import EdgeRolloff as EdgeRolloff
from .sensor.displacement import TreeRings as TreeRings
from .sensor.displacement import displace_stamps as displace_stamps
from .simulate.donuts import Donuts as Donuts
from .simulate.star_defects import StarDefects as StarDefects
