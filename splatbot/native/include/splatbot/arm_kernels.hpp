// SPDX-License-Identifier: Apache-2.0
#pragma once
namespace splatbot {
struct ArmKernels {};
}  // namespace splatbot
