-- Makes all charges of a request, in their order, or refuses all of them. ARGV has the strategy by which they were
-- decided, and five texts for each charge: the episode, the field of its verdicts, the position of the step in it (from
-- 1), the halves that want it, and 1 if an episode with a lease has no such step.
--
-- The halves are two characters, for a unit of the first and of the second half: 1 if the step is worth it. A field has
-- one character for each step: - not asked about, 0 not charged, 1 and 2 charged a unit of that half.
--
-- Numbers: the verdicts, plus 10 if the step was asked about before; none if the account has another strategy.
-- Refused: the index, from 0, of a charge beyond the end of its episode.

if ARGV[1] ~= fields[2] then
  return {balance(), {}, {}}
end

local leases = {}
for i = 2, #ARGV, 5 do
  local episode = ARGV[i]
  if leases[episode] == nil then
    leases[episode] = load_lease(episode)
  end
  if ARGV[i + 4] == '1' and leases[episode] then
    return {balance(), {}, {(i - 2) / 5}}
  end
end

-- Returns the half of the next unit that an episode with this lease (or without one) may spend, if there is one.
local function next_unit(lease)
  local assigned = spent + leased
  local available, early = assigned < budget, assigned < first_half
  if lease then
    available = not lease.settled and lease.spent < lease.units
    early = lease.spent < lease.early_units
  end
  return available and (early and 1 or 2) or nil
end

local words, changed_words, changed_leases, verdicts = {}, {}, {}, {}
for i = 2, #ARGV, 5 do
  local episode, field, position, wanted = ARGV[i], ARGV[i + 1], tonumber(ARGV[i + 2]), ARGV[i + 3]
  local word = words[field] or redis.call('HGET', KEYS[3], field) or ''
  local verdict = string.sub(word, position, position)
  local known = 10
  if verdict == '' or verdict == '-' then
    local lease = leases[episode]
    local half = next_unit(lease)
    known = 0
    verdict = '0'
    if half and string.sub(wanted, half, half) == '1' then
      verdict = tostring(half)
      spent = spent + 1
      if lease then
        lease.spent = lease.spent + 1
        leased = leased - 1
        changed_leases[episode] = lease
      end
    end
    word = word .. string.rep('-', position - 1 - #word)
    word = string.sub(word, 1, position - 1) .. verdict .. string.sub(word, position + 1)
    changed_words[field] = word
  end
  words[field] = word
  verdicts[#verdicts + 1] = tonumber(verdict) + known
end

for field, word in pairs(changed_words) do
  redis.call('HSET', KEYS[3], field, word)
end
for episode, lease in pairs(changed_leases) do
  save_lease(episode, lease)
end
if next(changed_words) then
  save_account()
end
return {balance(), verdicts, {}}
