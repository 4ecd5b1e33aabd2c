# ruff: isort: skip_file
from .chip_set import Chips as Chips, Label as Label, backdrop_of as backdrop_of, chips as chips
from .encoding import Encoding as Encoding
from .measured import MeasuredChips as MeasuredChips, write_measured_chips as write_measured_chips
from .write import write_chips as write_chips
