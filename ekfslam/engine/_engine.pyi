import numpy as np
import numpy.typing as npt

def cholesky(P: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]: ...
