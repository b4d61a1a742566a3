// The step of a body in contact along Newton's direction.
#pragma once

#include "kernels/soft/contact/contact_direction.h"

namespace diffsim {

enum class SearchResult {
  kDescended,  // x moved to where the merit, or the residual, is lower
  kFailed,     // no length lowers the merit; x was moved all the same, to change the statuses
  kAscends,    // the merit rises along the direction; x is where it was
};

/// Moves x along a direction as far as lowers the merit.
/// @param is_loose  the direction may be solved more accurately: where friction slides and it
///                  leads up, it is not searched
SearchResult search_along(ContactProblem& problem, const ContactDirection& direction, bool is_loose,
                          ContactIterate& at);

}  // namespace diffsim
