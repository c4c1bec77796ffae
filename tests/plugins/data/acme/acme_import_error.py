"""Cannot be imported."""

import acme_net_that_is_not_there  # noqa: F401
