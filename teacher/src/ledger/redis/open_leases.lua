-- Reserves units for episodes, in their order. ARGV: units per episode, then episodes. Numbers: units and early units
-- of each lease.

local leases = {}
for i = 2, #ARGV do
  local lease = load_lease(ARGV[i])
  if not lease then
    local assigned = spent + leased
    local units = math.min(tonumber(ARGV[1]), budget - assigned)
    local early_units = math.min(units, math.max(first_half - assigned, 0))
    lease = {units = units, early_units = early_units, spent = 0, settled = false}
    leased = leased + units
    save_lease(ARGV[i], lease)
  end
  leases[#leases + 1] = lease.units
  leases[#leases + 1] = lease.early_units
end
save_account()
return {balance(), leases, {}}
