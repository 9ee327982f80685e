#include "lstm_lanes.hpp"

namespace tauext::lanes {

const float kSaturation = 20.0f;

}  // namespace tauext::lanes
