"""Whether an image's derivatives are what its own differences say."""

from .certificate import Certificate as Certificate, check_gradients as check_gradients
