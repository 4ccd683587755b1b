"""How much one pixel counts in the window of another."""

from jscomb.numerics.weights.kinds import bilateral_weights as bilateral_weights
from jscomb.numerics.weights.kinds import feature_weights as feature_weights
from jscomb.numerics.weights.kinds import gaussian_weights as gaussian_weights
from jscomb.numerics.weights.kinds import in_noise as in_noise
from jscomb.numerics.weights.kinds import least_of as least_of
from jscomb.numerics.weights.kinds import noise_free_weights as noise_free_weights
from jscomb.numerics.weights.pairs import Pairs as Pairs
from jscomb.numerics.weights.pairs import Weights as Weights
from jscomb.numerics.weights.pairs import tile_weights as tile_weights
from jscomb.numerics.weights.pairs import weighted_mean as weighted_mean
