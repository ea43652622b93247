from .mesh import land_on_mesh as land_on_mesh
from .trace import TraceResult as TraceResult
